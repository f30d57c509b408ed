//! The training loop, checkpoints and evaluation.

pub mod calibration;
pub mod compact;
mod evaluate;
mod hooks;
mod photo;
mod quantile;
mod train;

pub use calibration::CalibrationSettings;
pub use evaluate::{Scores, ViewScore, evaluate};
pub use hooks::{Hook, HookView, Purpose};
pub use photo::{mask, photo};
#[doc(hidden)]
pub use train::expected_checksum;
pub use train::{
    Checkpoint, CheckpointError, Command, History, IntoLoss, LOSS_BATCH, LossRecord, LossTerms,
    Progress, RECIPES, Recipe, ShReduced, Snapshot, StrategyKind, TargetView, TrainError,
    TrainSettings, Trained, Trainer, TrainerBuilder, Warning, command_queue,
};
