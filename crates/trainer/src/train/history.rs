//! The log of a run.

use serde::{Deserialize, Serialize};

use super::Warning;

/// Everything logged during a run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct History {
    /// Names of the loss's terms.
    pub terms: Vec<String>,
    /// One entry per step whose loss was finite.
    pub losses: Vec<LossRecord>,
    /// Number of Gaussians at the start and after every change.
    pub counts: Vec<(usize, usize)>,
    /// Held-out PSNR in dB, by step, if measured.
    pub held_out_psnr: Vec<(usize, f64)>,
    /// When degrees of spherical harmonics were lowered, if they were.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sh_reduction: Option<ShReduced>,
    /// Warnings, each once.
    #[serde(default)]
    pub warnings: Vec<Warning>,
}

/// The loss of one step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LossRecord {
    /// The step, from 1.
    pub step: usize,
    /// Weighted sum.
    pub total: f32,
    /// Unweighted terms.
    pub terms: Vec<f32>,
}

/// A reduction of degrees of spherical harmonics, see
/// [`TrainSettings::sh_reduction`](super::TrainSettings::sh_reduction).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ShReduced {
    /// After this step.
    pub step: usize,
    /// How many Gaussians had degree 0, 1, 2 and 3 then.
    pub gaussians: [usize; 4],
}

impl std::fmt::Display for ShReduced {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { step, gaussians } = self;
        let [zero, one, two, three] = gaussians;
        write!(
            f,
            "after step {step}: {zero} Gaussians of degree 0, {one} of 1, {two} of 2, {three} of 3"
        )
    }
}

impl History {
    /// Mean total loss over the last `count` steps, if any.
    pub fn mean_loss(&self, count: usize) -> Option<f64> {
        let recent = &self.losses[self.losses.len().saturating_sub(count)..];
        (!recent.is_empty())
            .then(|| recent.iter().map(|r| f64::from(r.total)).sum::<f64>() / recent.len() as f64)
    }
}
