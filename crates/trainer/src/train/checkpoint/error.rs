//! Errors of checkpoints.

use std::path::PathBuf;

/// Why a checkpoint cannot be written or used.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// Reading or writing failed.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// Not a checkpoint of this program, or damaged.
    #[error("{path}: not a usable checkpoint: {reason}")]
    Format {
        /// The file.
        path: PathBuf,
        /// The reason.
        reason: String,
    },
    /// The checkpoint belongs to a run on another capture.
    #[error(
        "{path}: the run was begun on another capture (`{name}`): {difference}; give the capture it was begun on, with the --cameras and the photos of then, or begin another run in another folder"
    )]
    OtherCapture {
        /// The file.
        path: PathBuf,
        /// Name of the run's capture.
        name: String,
        /// The first difference.
        difference: String,
    },
    /// The checkpoint belongs to a run with other settings.
    #[error(
        "{path}: the run was begun with {difference}; leave that out to go on with the run's settings, or begin another run in another folder"
    )]
    OtherSettings {
        /// The file.
        path: PathBuf,
        /// Every such setting, with both values.
        difference: String,
    },
    /// No steps are left to train.
    #[error(
        "{path}: {done} of the run's {steps} steps are done; {wanted} would leave nothing to train, ask for more than {done}"
    )]
    NothingLeft {
        /// The file.
        path: PathBuf,
        /// Steps done.
        done: usize,
        /// Steps of the run.
        steps: usize,
        /// Requested steps.
        wanted: usize,
    },
    /// The state could not be read from the device, or contains values that a checkpoint cannot
    /// hold.
    #[error("the state of the run cannot be saved: {0}")]
    State(String),
}

impl CheckpointError {
    /// Identifies failures of one kind, so that each kind is reported once.
    pub(in super::super) fn kind(&self) -> String {
        match self {
            Self::Io { path, source } => format!("{} {:?}", path.display(), source.kind()),
            other => other.to_string(),
        }
    }
}
