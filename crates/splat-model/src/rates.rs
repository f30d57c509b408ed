//! Learning rates of the Gaussians (3DGS section 7.1; values of gsplat's default column).

use derive_setters::Setters;
use serde::{Deserialize, Serialize};

/// Learning rates per field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Setters)]
#[serde(default, deny_unknown_fields)]
#[setters(prefix = "with_", strip_option)]
pub struct LearningRates {
    /// Of the means at the first step, in units of the scene's scale.
    pub means: f64,
    /// The means' rate decays exponentially to this share of itself at the last step.
    pub means_final: f64,
    /// Of the log-scales.
    pub scales: f64,
    /// Of the quaternions.
    pub quats: f64,
    /// Of the opacity logits.
    pub opacities: f64,
    /// Of the spherical harmonics of degree 0.
    pub sh0: f64,
    /// Of the higher spherical harmonics.
    pub sh_rest: f64,
}

impl LearningRates {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }
}

impl Default for LearningRates {
    fn default() -> Self {
        Self {
            means: 1.6e-4,
            means_final: 0.01,
            scales: 5e-3,
            quats: 1e-3,
            opacities: 5e-2,
            sh0: 2.5e-3,
            sh_rest: 1.25e-4,
        }
    }
}

impl LearningRates {
    /// The rates by name, and how many times its default each is.
    pub fn factors(&self) -> [(&'static str, f64); 6] {
        let default = Self::default();
        [
            ("means", self.means / default.means),
            ("scales", self.scales / default.scales),
            ("quats", self.quats / default.quats),
            ("opacities", self.opacities / default.opacities),
            ("sh0", self.sh0 / default.sh0),
            ("sh_rest", self.sh_rest / default.sh_rest),
        ]
    }
}
