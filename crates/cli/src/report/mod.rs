//! Output of runs: pictures, curves, figures, progress.
//!
//! Everything is written by [`write_atomically`](splat_data::write_atomically), to a temporary file
//! that is then renamed, so that an interrupted run leaves either the old file or the new one. Data
//! that cannot be recomputed is written by [`write_durably`](splat_data::write_durably).

pub mod curves;
mod inputs;
pub mod losses;
pub mod metrics;
pub mod png;
pub mod progress;
pub mod view_names;

use std::path::{Path, PathBuf};

use splat_data::WriteError;

pub use inputs::refuse_inputs;
pub use splat_data::{probe_file, probe_files, probe_folder, write_atomically, write_durably};

/// Why a report could not be written. Every message is one line that names the file.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReportError {
    /// The file could not be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The file is an input of the command.
    #[error("{}: the command reads it, and would replace it; write to another place", path.display())]
    Input {
        /// The file.
        path: PathBuf,
    },
    /// The contents could not be encoded.
    #[error("{}: {reason}", path.display())]
    Encode {
        /// The file.
        path: PathBuf,
        /// The reason.
        reason: String,
    },
    /// The values of a picture do not match its size, or two pictures side by side differ in
    /// height.
    #[error("picture: {reason}")]
    Shape {
        /// The mismatch.
        reason: String,
    },
}

/// [`write_atomically`](splat_data::write_atomically), with an error that names the file.
fn write(path: &Path, contents: &[u8]) -> Result<(), ReportError> {
    splat_data::write_atomically(path, contents).map_err(|source| {
        ReportError::Write(WriteError {
            path: path.to_path_buf(),
            source,
        })
    })
}
