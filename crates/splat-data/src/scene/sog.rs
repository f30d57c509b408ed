//! SOG, PlayCanvas' compressed format: images of codes, 6 to 16 times smaller than PLY.
//!
//! A zip archive (`.sog`) or a folder with `meta.json` and lossless WebP images. Pixel i of every
//! image but the palette, counted by rows, belongs to Gaussian i; [`write()`] sorts them along a
//! Morton curve, so that neighbours look alike. Version 2 is written and read:
//!
//! | image | channels | read as |
//! |---|---|---|
//! | `means_l`, `means_u` | RGB: low and high byte of 16 bits | t from the least to the largest of the axis; sign(t) (e^\|t\| - 1) |
//! | `quats` | RGB: (w, x, y, z) without the largest; A: 252 + index of the largest | (value / 255 - 0.5) sqrt(2) |
//! | `scales` | RGB: entries of a codebook | the natural logarithm |
//! | `sh0` | RGB: entries of a codebook; A: opacity × 255 | the coefficient of degree 0 |
//! | `shN_labels` | R + 256 G: entry of the palette | |
//! | `shN_centroids` | 64 entries per row, a pixel for each coefficient; RGB: entries of a codebook | the coefficients of degrees 1 to 3 |
//!
//! Each codebook has up to 256 numbers, the palette up to 65,536 sets of coefficients. Positions
//! are most precise near zero: to half a step of (range of the logarithm) / 65535, times 1 + \|x\|.
//!
//! The axes are those of PLY files, and so ours, as PlayCanvas' programs write them; the text of
//! the specification names others (+y up), as it does for PLY.
//!
//! `extras.burn_splat` of `meta.json` holds what the format has no place for: the origin, the scene
//! scale and the background. Other programs see the scene without the offset of its origin. `model`
//! holds the anti-aliasing. A flat Gaussian's log-scale, minus infinity, is written as -1000.
//!
//! ```
//! use splat_data::{SplatData, scene::sog};
//!
//! # let folder = tempfile::tempdir()?;
//! # let path = folder.path().join("scene.sog");
//! let splats = SplatData {
//!     means: vec![[0.0, 0.5, 4.0]],
//!     log_scales: vec![[-2.0; 3]],
//!     quats: vec![[1.0, 0.0, 0.0, 0.0]],
//!     opacity_logits: vec![0.0],
//!     sh0: vec![[0.5; 3]],
//!     ..SplatData::default()
//! };
//! sog::write(&path, &splats)?;
//! let back = sog::read(&path)?;
//! assert_eq!(back.sh0, splats.sh0);
//! assert!((back.means[0][2] - 4.0).abs() < 1e-6);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod archive;
mod codebook;
mod fields;
mod image;
mod kmeans;
mod losses;
mod means;
mod meta;
mod palette;

use std::path::Path;

use derive_setters::Setters;

use super::{SceneFileError, SceneFormat, SplatData, values};
use crate::replace::write_durably;
use archive::Files;
use image::Grid;
use meta::{Coded, Means, Meta, Palette};

/// SOG files.
pub(super) const FORMAT: SceneFormat = SceneFormat {
    name: "SOG",
    endings: &["sog"],
    is: |head| head.starts_with(archive::ZIP) || head.trim_ascii_start().starts_with(b"{"),
    read: |path| read(path),
    write: |path, scene| write(path, scene),
    losses: losses::losses,
};

/// How precisely a scene is written.
#[derive(Debug, Clone, PartialEq, Eq, Setters)]
#[setters(prefix = "with_", strip_option)]
pub struct SogSettings {
    /// Most entries of the palette of spherical harmonics, 1 to 65,536. Default 65,536; never more
    /// than the largest power of two that is not above the number of Gaussians.
    pub palette: u32,
}

impl Default for SogSettings {
    fn default() -> Self {
        Self {
            palette: palette::MOST,
        }
    }
}

impl SogSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }
}

/// Writes `scene` to `path` as an archive with the default settings, replacing an existing file
/// only when the new one is complete and on the disk.
///
/// # Errors
///
/// [`SceneFileError::NotFinite`] for NaN or a meaningless infinity, [`SceneFileError::Shape`] for
/// inconsistent arrays, [`SceneFileError::Field`] for more Gaussians than an image has pixels,
/// [`SceneFileError::Io`] if the file cannot be written.
pub fn write(path: impl AsRef<Path>, scene: &SplatData) -> Result<(), SceneFileError> {
    write_with(path, scene, &SogSettings::default())
}

/// [`write()`] with settings.
///
/// # Errors
///
/// Those of [`write()`], and [`SceneFileError::Setting`] for settings out of range.
pub fn write_with(
    path: impl AsRef<Path>,
    scene: &SplatData,
    settings: &SogSettings,
) -> Result<(), SceneFileError> {
    let path = path.as_ref();
    if !(1..=palette::MOST).contains(&settings.palette) {
        return Err(SceneFileError::Setting {
            path: path.to_path_buf(),
            setting: "palette",
            value: settings.palette.to_string(),
            must_be: "from 1 to 65536",
        });
    }
    values::check(path, scene)?;
    let grid = Grid::of_count(scene.len()).ok_or_else(|| SceneFileError::Field {
        path: path.to_path_buf(),
        field: "count",
        reason: format!(
            "{} Gaussians; the images of SOG hold up to 268 million",
            scene.len()
        ),
    })?;

    let means = means::encode(scene);
    let order = means.order();
    let mut files = Files::default();
    let (low, high) = means.pixels(&order);
    let quats = fields::quats(scene, &order);
    let (scales, scale_codes) = fields::scales(scene, &order);
    let (colors, color_codes) = fields::colors(scene, &order);
    files.add("means_l.webp", image::encode(path, "means", grid, &low)?);
    files.add("means_u.webp", image::encode(path, "means", grid, &high)?);
    files.add("quats.webp", image::encode(path, "quats", grid, &quats)?);
    files.add(
        "scales.webp",
        image::encode(path, "scales", grid, &scale_codes)?,
    );
    files.add("sh0.webp", image::encode(path, "sh0", grid, &color_codes)?);
    let palette = match scene.sh_degree {
        0 => None,
        _ => Some(palette::encode(scene, &order, settings)),
    };
    if let Some(palette) = &palette {
        let pixels = &palette.labels;
        files.add("shN_labels.webp", image::encode(path, "shN", grid, pixels)?);
        let pixels = &palette.centroids;
        let image = image::encode(path, "shN", palette.grid, pixels)?;
        files.add("shN_centroids.webp", image);
    }
    let mut meta = Meta::of_scene(scene);
    meta.means = Means {
        mins: means.least,
        maxs: means.most,
        files: vec!["means_l.webp".into(), "means_u.webp".into()],
    };
    meta.scales = Coded::new(scales, "scales.webp");
    meta.quats.files = vec!["quats.webp".into()];
    meta.sh0 = Coded::new(colors, "sh0.webp");
    meta.sh_n = palette.map(|palette| Palette {
        count: palette.count,
        bands: scene.sh_degree,
        codebook: palette.codebook.into_iter().map(Some).collect(),
        files: vec!["shN_centroids.webp".into(), "shN_labels.webp".into()],
    });
    files.add("meta.json", meta.to_json());
    let io_error = |source| SceneFileError::Io {
        path: path.to_path_buf(),
        source,
    };
    write_durably(path, &files.pack().map_err(io_error)?).map_err(io_error)
}

/// Reads the scene in the archive `path`, or in the folder whose `meta.json` is `path`. Memory: at
/// most 40 MB and 800 bytes for each byte of the file or files.
///
/// # Errors
///
/// [`SceneFileError`], naming the file, the image and, if applicable, the Gaussian.
pub fn read(path: impl AsRef<Path>) -> Result<SplatData, SceneFileError> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).map_err(|source| SceneFileError::Io {
        path: path.to_path_buf(),
        source,
    })?;
    if bytes.starts_with(archive::ZIP) {
        return parse(path, &bytes);
    }
    let meta = Meta::parse(path, &bytes)?;
    let files = archive::open_folder(path, &meta)?;
    decode(path, &meta, &files)
}

/// [`read()`] from the contents of an archive; `path` is used in messages.
///
/// # Errors
///
/// Those of [`read()`].
pub fn parse(path: &Path, bytes: &[u8]) -> Result<SplatData, SceneFileError> {
    let mut archive = archive::Archive::open(path, bytes)?;
    let meta = Meta::parse(path, &archive.file("meta.json", "meta.json")?)?;
    let mut files = Files::default();
    for (field, name) in meta.images() {
        files.add(name, archive.file(field, name)?);
    }
    decode(path, &meta, &files)
}

fn decode(path: &Path, meta: &Meta, files: &Files) -> Result<SplatData, SceneFileError> {
    let count = meta.gaussians(path, files.bytes())?;
    let image = |field, names: &[String], at: usize| {
        let file = files.get(path, field, names, at)?;
        image::decode_gaussians(path, field, &file, count)
    };
    let (low, high) = (
        image("means", &meta.means.files, 0)?,
        image("means", &meta.means.files, 1)?,
    );
    let quats = image("quats", &meta.quats.files, 0)?;
    let scales = image("scales", &meta.scales.files, 0)?;
    let colors = image("sh0", &meta.sh0.files, 0)?;
    let (sh_degree, sh_rest) = match &meta.sh_n {
        Some(palette) if palette.bands > 0 => {
            let labels = image("shN", &palette.files, 1)?;
            let centroids = files.get(path, "shN", &palette.files, 0)?;
            let rest = palette::decode(path, palette, &centroids, &labels)?;
            (palette.bands, rest)
        }
        _ => (0, vec![]),
    };
    let (origin, settings) = meta.settings(path)?;
    let scene = SplatData {
        origin,
        means: means::decode(&meta.means, &low, &high),
        log_scales: fields::decode_scales(path, &meta.scales, &scales)?,
        quats: fields::decode_quats(path, &quats)?,
        opacity_logits: colors.iter().map(|pixel| values::logit(pixel[3])).collect(),
        sh0: fields::decode_colors(path, &meta.sh0, &colors)?,
        sh_rest,
        sh_degree,
        settings,
    };
    values::check(path, &scene)?;
    Ok(scene)
}

#[cfg(test)]
mod tests;
