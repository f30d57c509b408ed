//! Observers of a run, and its autosaves.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use super::commands::Commands;
use super::{Checkpoint, CheckpointError, Progress, Warning};

/// Stores a checkpoint outside the process.
type SaveCheckpoint = dyn FnMut(&Checkpoint) -> Result<(), CheckpointError> + Send;

/// Observers of a run, and its autosaves.
pub(super) struct Watch {
    pub(super) interrupt: Arc<AtomicBool>,
    pub(super) commands: Commands,
    pub(super) evaluate_every: Option<usize>,
    pub(super) autosave: Option<Autosave>,
    /// Takes the share of the adjustment of poses that is done.
    pub(super) on_adjustment: Box<dyn Fn(f64) + Send + Sync>,
    pub(super) on_progress: Box<dyn FnMut(Progress) + Send>,
    pub(super) on_warning: Box<dyn FnMut(&Warning) + Send>,
}

/// Saves the state of a run at intervals.
pub(super) struct Autosave {
    pub(super) every: Duration,
    pub(super) last: Instant,
    pub(super) save: Box<SaveCheckpoint>,
    /// Kinds of failure already reported.
    pub(super) failures: Vec<String>,
}

impl Default for Watch {
    /// No observers.
    fn default() -> Self {
        Self {
            interrupt: Arc::default(),
            commands: Commands::new(None),
            evaluate_every: None,
            autosave: None,
            on_adjustment: Box::new(|_| {}),
            on_progress: Box::new(|_| {}),
            on_warning: Box::new(|_| {}),
        }
    }
}
