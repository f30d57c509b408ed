//! Memory used by training on a CubeCL device, by the allocator's own count.
//!
//! Between steps, a Gaussian of degree 3 keeps 59 trained floats, two moments of each, and two sums
//! for density control. A step adds gradients, projected splats, and the state of the rasteriser,
//! whose bytes per Gaussian, intersection and pixel are in `splat_kernels::rasterize::Kept`.

use burn::tensor::Device;
use serde::{Deserialize, Serialize};

use super::PerformanceError;
use splat_trainer::Trainer;

/// Trained floats of a Gaussian: mean, scale, rotation, opacity, colour; and the coefficients of
/// the higher degrees, all of them once one is evaluated.
pub(super) const fn parameters(sh_degree: usize) -> u64 {
    let higher = if sh_degree == 0 { 0 } else { 45 };
    3 + 3 + 4 + 1 + 3 + higher
}

/// Bytes per Gaussian of degree 3 between steps.
pub const PER_GAUSSIAN_AT_REST: u64 = 4 * (3 * parameters(3) + 2);
/// Goal for the bytes per Gaussian between steps: a million in 1.2 GB.
pub const PER_GAUSSIAN_GOAL: u64 = 1200;

/// Memory of a run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DeviceMemory {
    /// Gaussians of the run.
    pub gaussians: u64,
    /// Bytes in use between two steps, excluding those in use before the run.
    pub at_rest_bytes: u64,
    /// Peak bytes in use at the beginning or end of a stage, excluding those in use before the run.
    /// Within a stage it may be more.
    pub most_bytes: u64,
    /// Bytes that the allocator has reserved from the device so far.
    pub reserved_bytes: u64,
}

impl DeviceMemory {
    /// Memory of a run between two steps, with `before` bytes in use when it began and `most`
    /// during its steps.
    pub(super) fn of(
        trainer: &Trainer,
        device: &Device,
        before: u64,
        most: u64,
    ) -> Result<Self, PerformanceError> {
        device.sync()?;
        let usage = device.memory_pool_usage();
        let usage = usage.ok_or(PerformanceError::NotCubeCl)?;
        Ok(Self {
            gaussians: trainer.model().len() as u64,
            at_rest_bytes: usage.bytes_in_use.saturating_sub(before),
            most_bytes: most.saturating_sub(before),
            reserved_bytes: usage.bytes_reserved,
        })
    }

    /// Bytes divided by the number of Gaussians.
    pub fn per_gaussian(&self, bytes: u64) -> f64 {
        bytes as f64 / self.gaussians.max(1) as f64
    }
}

/// Bytes in use on a device.
pub(super) fn in_use(device: &Device) -> Result<u64, PerformanceError> {
    let usage = device.memory_pool_usage();
    Ok(usage.ok_or(PerformanceError::NotCubeCl)?.bytes_in_use)
}
