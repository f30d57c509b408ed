//! Trained parameters of a model, by name: their row sets and learning rates.

use splat_data::SceneScale;

/// The row set of most parameters: one row per Gaussian.
pub const GAUSSIANS: usize = 0;

/// The row set of the coefficients of spherical harmonics of [`Gaussians`](crate::Gaussians) of
/// different degrees; a row is a coefficient of one function, of three channels. Far from the
/// numbers that models give sets of their own.
pub const SH_COEFFICIENTS: usize = 65_535;

/// A trained parameter of a [`SplatModel`](crate::SplatModel).
///
/// ```
/// use splat_model::Field;
///
/// let mask = Field::rows("mask", 0.01);
/// let nested = Field::rows("means", 1.6e-4).in_lengths().decaying_to(0.01).nested("gaussians");
/// assert_eq!((mask.path.as_str(), nested.path.as_str()), ("mask", "gaussians.means"));
/// assert_eq!(nested.name, "means");
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Field {
    /// Name used by strategies and settings, unique within a model. The strategies of this crate
    /// need `means`, `log_scales`, `quats` and `opacity_logits`, as in
    /// [`Gaussians`](crate::Gaussians).
    pub name: String,
    /// Path of the parameter in the Burn module: `means`, or `gaussians.means` in a model that
    /// contains one.
    pub path: String,
    /// Row set of the first dimension, or `None` for a parameter without rows, which row edits
    /// leave alone. [`GAUSSIANS`] is the set of all Gaussians; a model may have others, with as
    /// many rows as it likes. Rows of such a set may belong to the Gaussians, see
    /// [`SplatModel::owned_rows`](crate::SplatModel::owned_rows).
    pub row_set: Option<usize>,
    /// Learning rate at the first step.
    pub rate: f64,
    /// The rate decays exponentially to this share of itself at the last step. 1 means constant.
    pub final_share: f64,
    /// True if values are lengths in world units. Then the rate is in units of the scene's size,
    /// and so is Adam's epsilon, one over a length.
    pub is_length: bool,
}

impl Field {
    /// A parameter with a row per Gaussian and a constant learning rate.
    pub fn rows(name: impl Into<String>, rate: f64) -> Self {
        let name = name.into();
        Self {
            path: name.clone(),
            name,
            row_set: Some(GAUSSIANS),
            rate,
            final_share: 1.0,
            is_length: false,
        }
    }

    /// A parameter without rows: trained, but never edited.
    pub fn shared(name: impl Into<String>, rate: f64) -> Self {
        Self {
            row_set: None,
            ..Self::rows(name, rate)
        }
    }

    /// Declares values to be lengths in world units.
    #[must_use]
    pub fn in_lengths(mut self) -> Self {
        self.is_length = true;
        self
    }

    /// Makes the rate decay to a share of itself.
    #[must_use]
    pub fn decaying_to(mut self, share: f64) -> Self {
        self.final_share = share;
        self
    }

    /// Moves the field to another row set.
    #[must_use]
    pub fn in_row_set(mut self, row_set: usize) -> Self {
        self.row_set = Some(row_set);
        self
    }

    /// Prefixes the path with the name of the module that contains the model.
    #[must_use]
    pub fn nested(mut self, module: &str) -> Self {
        self.path = format!("{module}.{}", self.path);
        self
    }

    /// Learning rate at a step (from 0) of a run of `steps`.
    pub fn rate_at(&self, step: usize, steps: usize, scene: SceneScale) -> f64 {
        let progress = step as f64 / steps.max(1) as f64;
        let unit = if self.is_length { scene.length() } else { 1.0 };
        self.rate * unit * self.final_share.powf(progress)
    }
}
