//! The training loop, checkpoints and evaluation.

mod evaluate;
mod photo;
pub mod train;

pub use evaluate::{Scores, ViewScore, evaluate};
pub use photo::photo;
pub use train::{
    Checkpoint, CheckpointError, Command, History, Hook, HookView, LossTerms, Progress, Purpose,
    Snapshot, TargetView, TrainConfig, TrainError, Trained, Trainer, TrainerBuilder, Warning,
    command_queue,
};
