//! SPZ, Niantic's compressed format: 6 to 12 times smaller than PLY.
//!
//! [`write()`] writes version 4, [`read()`] reads versions 1 to 4. All numbers are little endian.
//!
//! ```text
//! 0   "NGSP"  u32 version = 4  u32 N  u8 SH degree  u8 fractional bits  u8 flags  u8 streams
//! 16  u32 offset of the table  12 zero bytes
//! 32  extensions, if flags & 2: u32 type  u32 length  bytes
//!     table: for each stream  u64 compressed bytes  u64 bytes
//!     the streams, one Zstandard frame each; those without bytes are left out
//! ```
//!
//! Flag 1 marks anti-aliasing. Versions 1 to 3 are one gzip stream: the first 16 bytes of this
//! header, whose last byte is 0, then the arrays, then extensions. The arrays, in this order:
//!
//! | array | of each Gaussian | read as |
//! |---|---|---|
//! | positions | 3 × 24-bit integer; 3 × half float in version 1 | value / 2^(fractional bits) |
//! | alphas | u8 | opacity × 255 |
//! | colours | 3 × u8 | ((value / 255) - 0.5) / 0.15, the coefficient of degree 0 |
//! | scales | 3 × u8 | value / 16 - 10, the natural logarithm |
//! | rotations | u32: index of the largest of (x, y, z, w), 2 bits, then of the others a sign and 9 bits; 3 × u8 in versions 1 and 2 | magnitude / 511 / sqrt(2) |
//! | SH | for each coefficient, 3 × u8 | (value - 128) / 128 |
//!
//! Axes: the file has +y up and +z backward, a [`SplatData`] +y down and +z forward, so y and z are
//! reversed, in positions, rotations and harmonics, unless the extension of Adobe names other axes.
//!
//! What is lost, beyond precision:
//!
//! - Values outside of the ranges above are clamped: scales below e^-10 or above e^5.9, colours
//!   beyond ±3.3, other coefficients beyond ±1. The ranges of scales are in world units, so a scene
//!   in very large units does not fit.
//! - There is no origin: it is added to the positions. [`write()`] refuses a scene so far from zero
//!   that 24 bits would blur it.
//! - There is neither scene scale nor background.
//! - Degree 4, which a file may have, is not read.
//!
//! ```
//! use splat_data::{SplatData, scene::spz};
//!
//! # let folder = tempfile::tempdir()?;
//! # let path = folder.path().join("scene.spz");
//! let splats = SplatData {
//!     means: vec![[0.0, 0.5, 4.0]],
//!     log_scales: vec![[-2.0; 3]],
//!     quats: vec![[1.0, 0.0, 0.0, 0.0]],
//!     opacity_logits: vec![0.0],
//!     sh0: vec![[0.5; 3]],
//!     ..SplatData::default()
//! };
//! spz::write(&path, &splats)?;
//! let back = spz::read(&path)?;
//! assert_eq!(back.means, splats.means);
//! assert!((back.sh0[0][0] - 0.5).abs() < 0.014);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod container;
mod extensions;
mod fields;
mod half;
mod header;
mod losses;
mod positions;

use std::path::Path;

use derive_setters::Setters;

use super::axes::AxisFlip;
use super::{SceneFileError, SceneFormat, SceneSettings, SplatData, values};
use crate::replace::write_durably;
use header::{ANTIALIASED, Header};
use positions::Grid;

/// SPZ files.
pub(super) const FORMAT: SceneFormat = SceneFormat {
    name: "SPZ",
    endings: &["spz"],
    is: |head| head.starts_with(header::MAGIC) || head.starts_with(container::GZIP),
    read: |path| read(path),
    write: |path, scene| write(path, scene),
    losses: losses::losses,
};

/// From the file's axes (+y up, +z backward) to ours, and back.
const FLIP: AxisFlip = AxisFlip {
    signs: [1.0, -1.0, -1.0],
};

/// How precisely a scene is written.
#[derive(Debug, Clone, PartialEq, Eq, Setters)]
#[setters(prefix = "with_", strip_option)]
pub struct SpzSettings {
    /// Bits of positions after the binary point, 0 to 30. Default: as many as the farthest Gaussian
    /// leaves of 23. Other programs write 12; fewer bits make a smaller file.
    pub fractional_bits: Option<u8>,
    /// Bits of the coefficients of degree 1, 1 to 8. Default 7; other programs write 5, which may
    /// cost more than 2 dB (docs/FORMATS.md).
    pub sh1_bits: u8,
    /// Bits of the coefficients of degrees 2 and 3, 1 to 8. Default 7; other programs write 4.
    pub sh_rest_bits: u8,
}

impl Default for SpzSettings {
    fn default() -> Self {
        Self {
            fractional_bits: None,
            sh1_bits: 7,
            sh_rest_bits: 7,
        }
    }
}

impl SpzSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }

    fn check(&self, path: &Path) -> Result<(), SceneFileError> {
        let bad = |setting, value: u8, must_be| {
            Err(SceneFileError::Setting {
                path: path.to_path_buf(),
                setting,
                value: value.to_string(),
                must_be,
            })
        };
        match *self {
            Self { sh1_bits, .. } if !(1..=8).contains(&sh1_bits) => {
                bad("sh1_bits", sh1_bits, "from 1 to 8")
            }
            Self { sh_rest_bits, .. } if !(1..=8).contains(&sh_rest_bits) => {
                bad("sh_rest_bits", sh_rest_bits, "from 1 to 8")
            }
            Self {
                fractional_bits: Some(bits),
                ..
            } if bits > header::MOST_FRACTIONAL_BITS => {
                bad("fractional_bits", bits, "from 0 to 30")
            }
            _ => Ok(()),
        }
    }
}

/// Writes `scene` to `path` with the default settings, replacing an existing file only when the new
/// one is complete and on the disk.
///
/// # Errors
///
/// [`SceneFileError::NotFinite`] for NaN or a meaningless infinity, [`SceneFileError::Field`] for
/// positions that do not fit, [`SceneFileError::Shape`] for inconsistent arrays,
/// [`SceneFileError::Io`] if the file cannot be written.
pub fn write(path: impl AsRef<Path>, scene: &SplatData) -> Result<(), SceneFileError> {
    write_with(path, scene, &SpzSettings::default())
}

/// [`write()`] with settings.
///
/// # Errors
///
/// Those of [`write()`], and [`SceneFileError::Setting`] for settings out of range.
pub fn write_with(
    path: impl AsRef<Path>,
    scene: &SplatData,
    settings: &SpzSettings,
) -> Result<(), SceneFileError> {
    let path = path.as_ref();
    settings.check(path)?;
    values::check(path, scene)?;
    let grid = Grid::choose(path, scene, settings.fractional_bits)?;
    let count = u32::try_from(scene.len()).map_err(|_| SceneFileError::Field {
        path: path.to_path_buf(),
        field: "points",
        reason: format!("{} Gaussians; SPZ holds up to {}", scene.len(), u32::MAX),
    })?;
    let antialias = scene.settings.antialias == Some(true);
    let header = Header {
        version: 4,
        count,
        sh_degree: scene.sh_degree as u8,
        fractional_bits: grid.fractional_bits(),
        flags: if antialias { ANTIALIASED } else { 0 },
    };
    let arrays = [
        grid.encode(scene),
        fields::encode_alphas(scene),
        fields::encode_colors(scene),
        fields::encode_scales(scene),
        fields::encode_rotations(scene),
        fields::encode_sh(scene, settings),
    ];
    let io_error = |source| SceneFileError::Io {
        path: path.to_path_buf(),
        source,
    };
    let bytes = container::pack(&header, &arrays).map_err(io_error)?;
    write_durably(path, &bytes).map_err(io_error)
}

/// Reads the scene in the file `path`. Memory: at most 20 MB and 700 bytes for each byte of the
/// file.
///
/// # Errors
///
/// [`SceneFileError`], naming the file, the array and, if applicable, the Gaussian.
pub fn read(path: impl AsRef<Path>) -> Result<SplatData, SceneFileError> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).map_err(|source| SceneFileError::Io {
        path: path.to_path_buf(),
        source,
    })?;
    parse(path, &bytes)
}

/// [`read()`] from the contents of a file; `path` is used in messages.
///
/// # Errors
///
/// Those of [`read()`].
pub fn parse(path: &Path, bytes: &[u8]) -> Result<SplatData, SceneFileError> {
    let packed = container::unpack(path, bytes)?;
    let header = &packed.header;
    let [positions, alphas, colors, scales, rotations, sh] = &packed.arrays;
    let extensions = extensions::read(path, &packed.extensions)?;
    let flip = extensions.flip.unwrap_or(FLIP);
    let mut not_understood = extensions.not_understood;
    if header.sh_degree > 3 {
        not_understood.push("spherical harmonics of degree 4".to_owned());
    }
    let scene = SplatData {
        origin: [0.0; 3],
        means: positions::decode(path, header, positions, flip)?,
        log_scales: fields::decode_scales(scales),
        quats: fields::decode_rotations(header, rotations, flip),
        opacity_logits: alphas.iter().map(|&alpha| values::logit(alpha)).collect(),
        sh0: fields::decode_colors(colors),
        sh_rest: fields::decode_sh(header, sh, flip),
        sh_degree: usize::from(header.sh_degree.min(3)),
        settings: SceneSettings {
            antialias: Some(header.flags & ANTIALIASED != 0),
            not_understood,
            ..SceneSettings::default()
        },
    };
    scene.check_shape()?;
    Ok(scene)
}

#[cfg(test)]
mod tests;
