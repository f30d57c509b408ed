//! The interface of a scene file format.

use std::path::Path;

use super::{SceneFileError, SplatData};

/// A format of scene files.
pub struct SceneFormat {
    /// Display name.
    pub name: &'static str,
    /// File extensions, without the dot, in lower case.
    pub endings: &'static [&'static str],
    /// True if a file is in this format, judged by its first 64 bytes (or all of a shorter file).
    pub is: fn(&[u8]) -> bool,
    /// Reads a file.
    pub read: fn(&Path) -> Result<SplatData, SceneFileError>,
    /// Writes a file atomically.
    pub write: fn(&Path, &SplatData) -> Result<(), SceneFileError>,
    /// What a file in this format cannot hold of a scene, beyond precision; one line each, for a
    /// warning.
    pub losses: fn(&SplatData) -> Vec<String>,
}
