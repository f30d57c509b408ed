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

impl History {
    /// Mean total loss over the last `count` steps, if any.
    pub fn mean_loss(&self, count: usize) -> Option<f64> {
        let recent = &self.losses[self.losses.len().saturating_sub(count)..];
        (!recent.is_empty())
            .then(|| recent.iter().map(|r| f64::from(r.total)).sum::<f64>() / recent.len() as f64)
    }
}
