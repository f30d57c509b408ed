//! The interface of a capture format.

use std::path::Path;

use super::sparse_model::SparseModel;
use super::{CaptureError, CaptureSettings, CaptureWarning};

/// A model with its warnings, or the reason that there is none.
pub(super) type ReadModel = Result<(SparseModel, Vec<CaptureWarning>), CaptureError>;

/// A way of storing cameras, images and points.
pub(super) struct CaptureFormat {
    /// Name in messages; of a file that is read, if a file may be named instead of the folder.
    pub name: &'static str,
    /// True if the folder holds a capture in this format, judged by file names.
    pub is_in: fn(&Path) -> bool,
    /// Reads and checks the cameras, images and points of the folder.
    pub read: fn(&Path, &CaptureSettings) -> ReadModel,
}
