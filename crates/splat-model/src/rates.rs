//! Learning rates of Gaussians (3DGS section 7.1; values of gsplat's default column).

use derive_setters::Setters;
use serde::{Deserialize, Serialize};

/// Steps of the runs for which rates are stated.
const STATED_STEPS: f64 = 30_000.0;
/// Runs of fewer steps have the rates of so many.
const FEWEST_STEPS: usize = 300;

/// Learning rates per field, as in a run of 30,000 steps.
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
    /// A run of fewer than 30,000 steps multiplies the rate of the means by (30,000 / steps) to the
    /// power of this, and the others, but for that of the opacities, by the square root of that
    /// factor; see [`for_steps`](Self::for_steps). 0 leaves all as they are. Default 0.5.
    pub short_run_exponent: f64,
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
            short_run_exponent: 0.5,
        }
    }
}

impl LearningRates {
    /// The rates of a run of so many steps.
    ///
    /// Adam moves a parameter by about its rate at each step, so that a run comes as far as its
    /// rates times its steps. With the rates of 30,000 steps, Gaussians come a fifteenth as far in
    /// 2,000, and stay where structure from motion had a point. Rates that grow by a root are
    /// between that and the noise of large steps. Opacities are fast as they are. Runs of fewer
    /// than 300 steps have the rates of 300. (Ours; measured in docs/RECIPES.md.)
    ///
    /// ```
    /// use splat_model::LearningRates;
    ///
    /// let rates = LearningRates::new();
    /// assert_eq!(rates.for_steps(30_000).means, 1.6e-4);
    /// let shorter = rates.for_steps(1_875);
    /// assert_eq!((shorter.means, shorter.scales), (4.0 * 1.6e-4, 2.0 * 5e-3));
    /// assert_eq!(shorter.opacities, rates.opacities);
    /// ```
    #[must_use]
    pub fn for_steps(&self, steps: usize) -> Self {
        let shorter = (STATED_STEPS / steps.max(FEWEST_STEPS) as f64).max(1.0);
        let far = shorter.powf(self.short_run_exponent);
        let factor = far.sqrt();
        Self {
            means: self.means * far,
            scales: self.scales * factor,
            quats: self.quats * factor,
            sh0: self.sh0 * factor,
            sh_rest: self.sh_rest * factor,
            ..self.clone()
        }
    }

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
