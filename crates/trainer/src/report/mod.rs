//! What a run leaves behind and shows: pictures, curves, figures, progress.
//!
//! Everything is written by [`write_atomically`]: beside its place first, then renamed, so that an interrupted run
//! leaves either the old file or the new one; what cannot be made again by [`write_durably`].

mod atomic;
pub mod curves;
mod inputs;
pub mod losses;
pub mod memory;
pub mod metrics;
pub mod png;
pub mod progress;
pub mod view_names;

use std::path::PathBuf;

pub use atomic::{probe_file, probe_files, probe_folder, write_atomically, write_durably};
pub use inputs::refuse_inputs;

/// Why a report could not be written. Every message is one line that names the file.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReportError {
    /// The file could not be written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is one that the command reads.
    #[error("{}: the command reads this file, and would replace it; write to another place", path.display())]
    Input {
        /// The file.
        path: PathBuf,
    },
    /// The contents could not be encoded.
    #[error("{}: {reason}", path.display())]
    Encode {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A picture whose values do not fill its size, or two of different height side by side.
    #[error("picture: {reason}")]
    Shape {
        /// What does not fit.
        reason: String,
    },
}
