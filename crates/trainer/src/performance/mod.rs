//! How fast it is on the CPU, what the time goes to, and how that grows: `splat bench step|rasterize|scaling`.
//!
//! Nothing here is a copy of what it measures: steps are those of the [`Trainer`](crate::Trainer), and their stages are
//! the `tracing` spans in it and in the ops.

mod machine;
pub mod page;
pub mod rasterize;
pub mod scaling;
mod spread;
pub mod stages;
pub mod step;
mod step_plot;
mod threads;
mod work;

pub use machine::Machine;
pub use spread::Spread;
pub use threads::{all_threads, on_threads};
pub use work::Work;

use splat_ops::OpError;

use crate::TrainError;

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
    /// The process that measures a point of the scaling did not.
    #[error("{gaussians} Gaussians, {pixels} pixels: {reason}")]
    Point {
        /// Gaussians of the point.
        gaussians: usize,
        /// Pixels of the point.
        pixels: usize,
        /// What went wrong.
        reason: String,
    },
}
