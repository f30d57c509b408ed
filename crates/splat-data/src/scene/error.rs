//! What can be wrong with a scene file.

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
        /// What the system said.
        source: std::io::Error,
    },
    /// The header is not that of a PLY file of splats.
    #[error("{}: {reason}", path.display())]
    Header {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A property that a splat needs is not in the header.
    #[error("{}: vertices lack the property `{property}`; this is no PLY file in the 3DGS layout", path.display())]
    MissingProperty {
        /// The file.
        path: PathBuf,
        /// Name of the property.
        property: String,
    },
    /// The number of `f_rest_*` properties belongs to no degree of spherical harmonics.
    #[error(
        "{}: {count} properties f_rest_*; spherical harmonics of degree 0, 1, 2, 3 have 0, 9, 24, 45",
        path.display()
    )]
    RestCount {
        /// The file.
        path: PathBuf,
        /// How many there are.
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
        /// How many the header announces.
        count: usize,
    },
    /// A line of an ASCII file that cannot be read.
    #[error("{}: Gaussian {index}: {reason}", path.display())]
    BadElement {
        /// The file.
        path: PathBuf,
        /// The Gaussian.
        index: usize,
        /// What is wrong with it.
        reason: String,
    },
    /// A value that is NaN, or infinite where that means nothing: opacity logits may be infinite,
    /// log-scales minus infinite.
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
    /// A setting of the scene that no reader would take.
    #[error("{}: {setting} is {value}; it must be {must_be}", path.display())]
    Setting {
        /// The file.
        path: PathBuf,
        /// Name of the setting, as [`SceneSettings`](super::SceneSettings) has it.
        setting: &'static str,
        /// The value.
        value: String,
        /// What would do.
        must_be: &'static str,
    },
    /// Arrays of a scene that do not fit each other.
    #[error("scene: {field} has {len} entries instead of {expected}")]
    Shape {
        /// Name of the array.
        field: &'static str,
        /// Its length.
        len: usize,
        /// The length that fits.
        expected: usize,
    },
}
