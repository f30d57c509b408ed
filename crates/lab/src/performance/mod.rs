//! How fast it is, what the time goes to, and how that grows: `splat bench step|rasterize|scaling`,
//! on the CPU or on a CubeCL device.
//!
//! Nothing here is a copy of what it measures: steps are those of the
//! [`Trainer`](splat_trainer::Trainer), and their stages are the `tracing` spans in it and in the
//! ops.

mod arithmetic;
mod device_memory;
pub mod device_step;
mod limits;
mod machine;
pub mod page;
pub mod rasterize;
pub mod scaling;
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

/// What keeps a measurement from being made.
#[derive(Debug, thiserror::Error)]
pub enum PerformanceError {
    /// A step could not be taken.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// An op refused its input.
    #[error(transparent)]
    Op(#[from] OpError),
    /// Threads could not be started.
    #[error("threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
    /// A device stopped working.
    #[error("the device: {0}")]
    Device(#[from] ExecutionError),
    /// A figure of CubeCL devices was asked of another.
    #[error("the device is none of CubeCL's; choose one with --device wgpu or --device cuda")]
    NotCubeCl,
    /// The process that measures a point of the scaling did not.
    #[error("{gaussians} Gaussians, {size} pixels: {reason}")]
    Point {
        /// Gaussians of the point.
        gaussians: usize,
        /// Its photos.
        size: scaling::PhotoSize,
        /// What went wrong.
        reason: String,
    },
}
