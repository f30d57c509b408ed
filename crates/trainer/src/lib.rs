//! The training loop, checkpoints and evaluation.

mod evaluate;
mod photo;
pub mod train;

pub use evaluate::{Scores, ViewScore, evaluate};
pub use photo::photo;
pub use train::{LossTerms, TargetView, TrainConfig, TrainError, Trained, Trainer, Warning};
