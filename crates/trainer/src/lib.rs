//! The training loop, checkpoints and evaluation.

mod evaluate;
mod hooks;
mod photo;
pub mod train;

pub use evaluate::{Scores, ViewScore, evaluate};
pub use hooks::{Hook, HookView, Purpose};
pub use photo::photo;
pub use train::{
    Checkpoint, CheckpointError, Command, History, LossTerms, Progress, Snapshot, TargetView,
    TrainError, TrainSettings, Trained, Trainer, TrainerBuilder, Warning, command_queue,
};
