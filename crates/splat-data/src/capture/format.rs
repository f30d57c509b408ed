//! What a format of captures is.

use std::path::Path;

use super::sparse_model::SparseModel;
use super::{CaptureError, CaptureWarning};

/// A model and what is odd about it, or why there is none.
pub(super) type ReadModel = Result<(SparseModel, Vec<CaptureWarning>), CaptureError>;

/// A way to store cameras, images and points.
pub(super) struct CaptureFormat {
    /// Whether the folder holds a capture in it, as far as names of files tell.
    pub is_in: fn(&Path) -> bool,
    /// Reads and checks the cameras, images and points of the folder.
    pub read: fn(&Path) -> ReadModel,
}
