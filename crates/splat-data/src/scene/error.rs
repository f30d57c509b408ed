//! Errors of scene files.

use std::path::PathBuf;

/// Why a scene file cannot be read or written. Every message is one line that names the file, the
/// property and the Gaussian (counted from 0).
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SceneFileError {
    /// The file could not be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The header is not that of a scene.
    #[error("{}: {reason}", path.display())]
    Header {
        /// The file.
        path: PathBuf,
        /// The reason.
        reason: String,
    },
    /// A required property is missing from the header.
    #[error("{}: vertices lack the property `{property}`; this is no PLY file in the 3DGS layout", path.display())]
    MissingProperty {
        /// The file.
        path: PathBuf,
        /// Name of the property.
        property: String,
    },
    /// The number of `f_rest_*` properties matches no degree of spherical harmonics.
    #[error(
        "{}: {count} properties f_rest_*; spherical harmonics of degree 0, 1, 2, 3 have 0, 9, 24, 45",
        path.display()
    )]
    RestCount {
        /// The file.
        path: PathBuf,
        /// Number of `f_rest_*` properties.
        count: usize,
    },
    /// The file holds no Gaussian.
    #[error("{}: the file holds no Gaussian", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// The file ends before its last Gaussian.
    #[error("{}: truncated: the file ends in Gaussian {index} of {count}", path.display())]
    Truncated {
        /// The file.
        path: PathBuf,
        /// The Gaussian being read.
        index: usize,
        /// Number of Gaussians in the header.
        count: usize,
    },
    /// A line of an ASCII file cannot be read.
    #[error("{}: Gaussian {index}: {reason}", path.display())]
    BadElement {
        /// The file.
        path: PathBuf,
        /// The Gaussian.
        index: usize,
        /// The reason.
        reason: String,
    },
    /// A value is NaN, or infinite where infinity is meaningless: opacity logits may be infinite,
    /// and log-scales minus infinity.
    #[error("{}: Gaussian {index}: {property} is {value}", path.display())]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// The Gaussian.
        index: usize,
        /// Name of the property.
        property: String,
        /// The value.
        value: f32,
    },
    /// An array or entry of a file is malformed, or a scene's array does not fit a format.
    #[error("{}: {field}: {reason}", path.display())]
    Field {
        /// The file.
        path: PathBuf,
        /// The array or entry.
        field: &'static str,
        /// The reason.
        reason: String,
    },
    /// A setting of the scene or its writer that is out of range.
    #[error("{}: {setting} is {value}; it must be {must_be}", path.display())]
    Setting {
        /// The file.
        path: PathBuf,
        /// Name of the setting in [`SceneSettings`](super::SceneSettings) or in those of a writer.
        setting: &'static str,
        /// The value.
        value: String,
        /// The allowed values.
        must_be: &'static str,
    },
    /// Arrays of a scene have inconsistent lengths.
    #[error("scene: {field} has {len} entries instead of {expected}")]
    Shape {
        /// Name of the array.
        field: &'static str,
        /// Its length.
        len: usize,
        /// The expected length.
        expected: usize,
    },
}
