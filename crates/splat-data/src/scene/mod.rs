//! Scene files: trained splats as plain data ([`SplatData`]), without tensors.
//!
//! [`read()`] and [`write()`] recognise the format by the file: [`ply`] is the layout of the 3DGS
//! paper's code, exact and read by every viewer, [`spz`] and [`sog`] are several times smaller.
//!
//! ```
//! use splat_data::{SplatData, scene};
//!
//! let splats = SplatData {
//!     means: vec![[0.0, 0.0, 4.0]],
//!     log_scales: vec![[-2.0; 3]],
//!     quats: vec![[1.0, 0.0, 0.0, 0.0]],
//!     opacity_logits: vec![0.0],
//!     sh0: vec![[0.5; 3]],
//!     ..SplatData::default()
//! };
//! # let folder = tempfile::tempdir()?;
//! let path = folder.path().join("scene.ply");
//! scene::write(&path, &splats)?;
//! assert_eq!(scene::read(&path)?.means, splats.means);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

pub mod ply;
pub mod sog;
pub mod spz;

mod axes;
mod edit;
mod error;
mod format;
mod formats;
mod limits;
#[cfg(test)]
mod test_scene;
mod values;

pub use error::SceneFileError;
pub use format::SceneFormat;
pub use formats::{FORMATS, format_to_write, read, write};

use crate::{Capture, SceneScale};

/// A scene as stored in files: plain arrays, one entry per Gaussian, in the trained
/// parametrisation.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SplatData {
    /// Origin of the means in the world. Zero unless the scene is far from the world's zero, as in
    /// map coordinates, where 32-bit floats would lose detail.
    pub origin: [f64; 3],
    /// Centres relative to `origin`, `[N][3]`, world units.
    pub means: Vec<[f32; 3]>,
    /// Natural logarithm of the scales, `[N][3]`.
    pub log_scales: Vec<[f32; 3]>,
    /// Quaternions (w, x, y, z), any non-zero length, `[N][4]`.
    pub quats: Vec<[f32; 4]>,
    /// Opacity before the sigmoid, `[N]`.
    pub opacity_logits: Vec<f32>,
    /// Coefficient of the constant spherical harmonic, `[N][3]` (RGB).
    pub sh0: Vec<[f32; 3]>,
    /// Remaining coefficients, `[N][K - 1][3]` flattened with `K = (sh_degree + 1)^2`: for each
    /// Gaussian its coefficients in order, each with its three channels.
    pub sh_rest: Vec<f32>,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: usize,
    /// Render settings, as far as they are known.
    pub settings: SceneSettings,
}

/// Settings that reproduce a scene's look at training. They are part of the scene and of its file;
/// `None` if the file does not say.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SceneSettings {
    /// Size of the scene in world units, the unit of the renderer's lengths; positive.
    pub scene_scale: Option<f64>,
    /// True if opacities are multiplied by the compensation of the low-pass filter.
    pub antialias: Option<bool>,
    /// Colour behind the scene, linear RGB; black is zero.
    pub background: Option<[f32; 3]>,
    /// Render settings in the file that this program does not support, one line each; for a
    /// warning, and not written.
    pub not_understood: Vec<String>,
}

impl SceneSettings {
    /// Takes from the capture that the scene is of what its file does not say: its size, without
    /// which near and far plane follow from the spread of the Gaussians and are not those of
    /// training, and the background.
    pub fn complete_from(&mut self, capture: &Capture) {
        (self.scene_scale).get_or_insert_with(|| capture.scene_scale().length());
        self.background = self.background.or(capture.background);
    }
}

impl SplatData {
    /// Size of the scene: from its settings, or else from the spread of its Gaussians.
    pub fn scene_scale(&self) -> SceneScale {
        let said = self.settings.scene_scale.and_then(SceneScale::new);
        said.unwrap_or_else(|| SceneScale::of_splats(self))
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// True if there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Number of values [`SplatData::sh_rest`] holds per Gaussian: `3 ((sh_degree + 1)^2 - 1)`.
    pub fn sh_rest_len(&self) -> usize {
        3 * ((self.sh_degree + 1).pow(2) - 1)
    }

    /// Checks that every array has an entry for each Gaussian and that the degree is at most 3.
    ///
    /// # Errors
    ///
    /// [`SceneFileError::Shape`], naming the array.
    pub fn check_shape(&self) -> Result<(), SceneFileError> {
        let count = self.len();
        if self.sh_degree > 3 {
            return Err(SceneFileError::Shape {
                field: "sh_degree",
                len: self.sh_degree,
                expected: 3,
            });
        }
        let lengths = [
            ("log_scales", self.log_scales.len(), count),
            ("quats", self.quats.len(), count),
            ("opacity_logits", self.opacity_logits.len(), count),
            ("sh0", self.sh0.len(), count),
            ("sh_rest", self.sh_rest.len(), count * self.sh_rest_len()),
        ];
        match lengths.iter().find(|(_, len, expected)| len != expected) {
            None => Ok(()),
            Some(&(field, len, expected)) => Err(SceneFileError::Shape {
                field,
                len,
                expected,
            }),
        }
    }
}
