//! What a format of scene files is.

use std::path::Path;

use super::{SceneFileError, SplatData};

/// A format of scene files.
pub struct SceneFormat {
    /// What people call it.
    pub name: &'static str,
    /// Endings of its files, without the dot, in lower case.
    pub endings: &'static [&'static str],
    /// Whether a file begins as one in this format does, given its first 64 bytes or all of a
    /// shorter one.
    pub is: fn(&[u8]) -> bool,
    /// Reads a file.
    pub read: fn(&Path) -> Result<SplatData, SceneFileError>,
    /// Writes a file, whole or not at all.
    pub write: fn(&Path, &SplatData) -> Result<(), SceneFileError>,
}
