//! Captures, the training loop, evaluation, reports, and the `splat` program.

#[cfg(feature = "cpu")]
pub mod accuracy;
pub mod capture;
pub mod cli;
mod evaluate;
#[doc(hidden)]
pub mod fuzzing;
pub mod gradcheck;
#[cfg(feature = "cpu")]
pub mod performance;
pub mod report;
mod text;
pub mod train;

pub use capture::{Capture, CaptureOptions};
pub use evaluate::{Scores, ViewScore, evaluate};
pub use train::{LossTerms, TargetView, TrainConfig, TrainError, Trained, Trainer, Warning};
