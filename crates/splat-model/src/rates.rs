//! Learning rates of Gaussians (3DGS section 7.1; values of gsplat's default column).

use derive_setters::Setters;
use serde::{Deserialize, Serialize};

/// Learning rates per field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Setters)]
#[serde(default, deny_unknown_fields)]
#[setters(prefix = "with_", strip_option)]
pub struct LearningRates {
    /// Rate of the means at the first step, in units of the scene's scale.
    pub means: f64,
    /// The means' rate decays exponentially to this share of itself at the last step.
    pub means_final: f64,
    /// Rate of the log-scales.
    pub scales: f64,
    /// Rate of the quaternions.
    pub quats: f64,
    /// Rate of the opacity logits.
    pub opacities: f64,
    /// Rate of the spherical harmonics of degree 0.
    pub sh0: f64,
    /// Rate of the higher spherical harmonics.
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
    /// Rates by name, as multiples of their defaults.
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
