//! Memory that training takes on a CubeCL device, by the allocator's own count.
//!
//! Between steps there are, of every Gaussian of degree 3: 59 floats that are trained, two moments
//! of each, and two sums for density control. Within a step come its gradients, what is projected,
//! and what the rasteriser keeps; of the latter `splat_kernels::rasterize::Kept` has the bytes per
//! Gaussian, intersection and pixel.

use burn::tensor::Device;
use serde::{Deserialize, Serialize};

use super::PerformanceError;
use splat_trainer::Trainer;

/// Floats of a Gaussian that are trained: mean, scale, rotation, opacity, colour; and the
/// coefficients of the higher degrees, all of them as soon as one is evaluated.
pub(super) const fn parameters(sh_degree: usize) -> u64 {
    let higher = if sh_degree == 0 { 0 } else { 45 };
    3 + 3 + 4 + 1 + 3 + higher
}

/// Bytes of a Gaussian of degree 3 between steps.
pub const PER_GAUSSIAN_AT_REST: u64 = 4 * (3 * parameters(3) + 2);
/// What they shall not exceed: a million in 1.2 GB.
pub const PER_GAUSSIAN_GOAL: u64 = 1200;

/// Memory of a run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DeviceMemory {
    /// Gaussians of the run.
    pub gaussians: u64,
    /// Bytes in use between two steps, without what others had in use before the run.
    pub at_rest_bytes: u64,
    /// The most seen in use at the beginning or end of a stage, likewise. Within a stage it may be
    /// more.
    pub most_bytes: u64,
    /// Bytes that the allocator has taken from the device so far, for whatever will be needed.
    pub reserved_bytes: u64,
}

impl DeviceMemory {
    /// Of a run between two steps, `before` bytes in use when it began and `most` during some of
    /// its steps.
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

    /// So many bytes as a share of one Gaussian.
    pub fn per_gaussian(&self, bytes: u64) -> f64 {
        bytes as f64 / self.gaussians.max(1) as f64
    }
}

/// Bytes in use on a device.
pub(super) fn in_use(device: &Device) -> Result<u64, PerformanceError> {
    let usage = device.memory_pool_usage();
    Ok(usage.ok_or(PerformanceError::NotCubeCl)?.bytes_in_use)
}
