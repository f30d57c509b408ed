//! Speed, its breakdown by stage, and its growth: `splat bench step|rasterize|scaling|sparse`, on
//! the CPU or a CubeCL device.
//!
//! Nothing here duplicates the measured code: steps are those of the
//! [`Trainer`](splat_trainer::Trainer), and stages are the `tracing` spans in it and in the ops.

mod arithmetic;
mod device_memory;
pub mod device_step;
mod limits;
mod machine;
pub mod page;
pub mod rasterize;
pub mod scaling;
pub mod sparse;
mod spread;
pub mod stages;
pub mod step;
mod step_row;
mod threads;
mod work;

pub use device_memory::{DeviceMemory, PER_GAUSSIAN_AT_REST};
pub use machine::Machine;
pub use spread::Spread;
pub use threads::{all_threads, on_threads};
pub use work::Work;

use burn::backend::ExecutionError;
use splat_ops::OpError;

use splat_trainer::TrainError;

/// Why a measurement cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum PerformanceError {
    /// A training step failed.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// An op refused its input.
    #[error(transparent)]
    Op(#[from] OpError),
    /// Threads could not be started.
    #[error("threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
    /// A device failed.
    #[error("the device: {0}")]
    Device(#[from] ExecutionError),
    /// A figure for CubeCL devices was requested for another device.
    #[error("the device is none of CubeCL's; choose one with --device wgpu or --device cuda")]
    NotCubeCl,
    /// The process that measures a point of the scaling failed.
    #[error("{gaussians} Gaussians, {size} pixels: {reason}")]
    Point {
        /// Gaussians of the point.
        gaussians: usize,
        /// Size of its photos.
        size: scaling::PhotoSize,
        /// The reason.
        reason: String,
    },
}
