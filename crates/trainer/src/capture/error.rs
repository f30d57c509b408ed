//! What can be wrong with a capture, and what can be odd about it.

use std::path::PathBuf;

/// Why a capture cannot be used. Every message is one line that names the file and says what to do.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CaptureError {
    /// A file or folder could not be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

/// Something odd about a capture that did not prevent reading it.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum CaptureWarning {}
