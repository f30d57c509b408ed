//! Training: render a view, measure the loss, step the optimisers, let the strategy edit the rows,
//! repeat (3DGS sections 5 and 7.1).

mod builder;
mod checkpoint;
mod commands;
mod error;
mod fingerprint;
mod first;
mod history;
mod loss;
mod loss_log;
mod progress;
mod recipe;
mod resolution_schedule;
mod room;
mod run;
mod settings;
mod sh_reduction;
mod sh_schedule;
mod spectrum;
mod state;
mod trainer;
mod training_views;
mod views;
mod warnings;
mod watch;

#[cfg(all(test, feature = "cpu"))]
mod tests;

pub use builder::TrainerBuilder;
#[doc(hidden)]
pub use checkpoint::expected_checksum;
pub use checkpoint::{Checkpoint, CheckpointError};
pub use commands::{Command, Snapshot, command_queue};
pub use error::TrainError;
pub use history::{History, LossRecord, ShReduced};
pub use loss::{IntoLoss, LossTerms, TargetView};
pub use loss_log::LOSS_BATCH;
pub use progress::{Progress, Trained};
pub use recipe::{RECIPES, Recipe};
pub use settings::{StrategyKind, TrainSettings};
pub use trainer::Trainer;
pub use warnings::Warning;
