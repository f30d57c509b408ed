//! The trained parameters of a model, by name: which have a row per Gaussian, and how fast each is
//! trained.

use splat_data::SceneScale;

/// The row set of most parameters: one row per Gaussian.
pub const GAUSSIANS: usize = 0;

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
    /// What strategies and settings call it; no two fields of a model share a name. Every model
    /// that the strategies of this crate work on has `means`, `log_scales`, `quats` and
    /// `opacity_logits`, as [`Gaussians`](crate::Gaussians) has.
    pub name: String,
    /// Where Burn finds the parameter in the module: `means`, or `gaussians.means` in a model that
    /// is made of one.
    pub path: String,
    /// The row set that its first dimension runs over; none for a parameter without a row per
    /// Gaussian, which no edit of rows touches. [`GAUSSIANS`] is the set of all; a model may have
    /// others, with fewer rows.
    pub row_set: Option<usize>,
    /// Learning rate at the first step.
    pub rate: f64,
    /// The rate decays exponentially to this share of itself at the last step. 1: it is constant.
    pub final_share: f64,
    /// Whether values are lengths in world units: then the rate is in units of the scene's size,
    /// and Adam's epsilon, one over a length, follows it too.
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

    /// A parameter that has no row per Gaussian: trained, and never edited.
    pub fn shared(name: impl Into<String>, rate: f64) -> Self {
        Self {
            row_set: None,
            ..Self::rows(name, rate)
        }
    }

    /// The same with values that are lengths in world units.
    #[must_use]
    pub fn in_lengths(mut self) -> Self {
        self.is_length = true;
        self
    }

    /// The same with a rate that decays to a share of itself.
    #[must_use]
    pub fn decaying_to(mut self, share: f64) -> Self {
        self.final_share = share;
        self
    }

    /// The same in another row set.
    #[must_use]
    pub fn in_row_set(mut self, row_set: usize) -> Self {
        self.row_set = Some(row_set);
        self
    }

    /// The same in a module that holds the model under this name.
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
