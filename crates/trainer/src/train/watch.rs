//! Who watches a run, and what is kept of it on the way.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use super::commands::Commands;
use super::{Checkpoint, CheckpointError, Progress, Warning};

/// Puts a checkpoint where it outlives the process.
type SaveCheckpoint = dyn FnMut(&Checkpoint) -> Result<(), CheckpointError> + Send;

/// Who watches a run, and what is kept of it on the way.
pub(super) struct Watch {
    pub(super) interrupt: Arc<AtomicBool>,
    pub(super) commands: Commands,
    pub(super) evaluate_every: Option<usize>,
    pub(super) autosave: Option<Autosave>,
    pub(super) on_progress: Box<dyn FnMut(Progress) + Send>,
    pub(super) on_warning: Box<dyn FnMut(&Warning) + Send>,
}

/// Keeps the state of a run from time to time.
pub(super) struct Autosave {
    pub(super) every: Duration,
    pub(super) last: Instant,
    pub(super) save: Box<SaveCheckpoint>,
    /// Kinds of failure that were told.
    pub(super) failures: Vec<String>,
}

impl Default for Watch {
    /// Nobody.
    fn default() -> Self {
        Self {
            interrupt: Arc::default(),
            commands: Commands::new(None),
            evaluate_every: None,
            autosave: None,
            on_progress: Box::new(|_| {}),
            on_warning: Box::new(|_| {}),
        }
    }
}
