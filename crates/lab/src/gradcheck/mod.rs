//! Gradient checks of the ops on any device against a scene with known gradients (a fixture).
//!
//! ```text
//! *.safetensors ──fixture──> scene, expected ──run──> rendered, gradients ──judge──> FileReport ──report──> table, JSON
//! ```
//!
//! In single precision, pixels on a blending threshold are excluded (`left_out.rs`).
//!
//! The fixtures come from PyTorch in float64 (`tests/fixtures/generate.py`); any framework can
//! write one. [`check_file`] checks one file.

mod fixture;
mod judge;
#[cfg(feature = "cpu")]
mod left_out;
mod report;
mod rounding;
mod run;
mod scene;
mod thresholds;

use std::path::{Path, PathBuf};

use burn::tensor::{DType, Device};
use splat_ops::OpError;

pub use fixture::Fixture;
#[doc(hidden)]
pub use fixture::KEYS as FIXTURE_KEYS;
#[cfg(feature = "cpu")]
pub(crate) use fixture::unique::check as check_unique_names;
#[cfg(feature = "cpu")]
pub(crate) use judge::relative_l2;
pub use judge::{FileReport, GroupReport, OutputReport, compare, gate};
pub use report::{json, table};
pub use run::{Bug, Computed, run};
#[cfg(feature = "cpu")]
pub(crate) use scene::index_of;
pub use scene::{Array, Inputs, Outputs, Scene};
pub use thresholds::{NEAR, Walk, near_in_single, walk};

/// Floating point type of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Precision {
    /// Single precision, on every device.
    F32,
    /// Double precision, on the CPU (Flex) device only.
    F64,
}

impl Precision {
    /// The corresponding Burn type.
    pub fn dtype(self) -> DType {
        match self {
            Self::F32 => DType::F32,
            Self::F64 => DType::F64,
        }
    }
}

impl std::fmt::Display for Precision {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::F32 => "f32",
            Self::F64 => "f64",
        })
    }
}

/// Why a fixture cannot be checked. Every message names the file.
#[derive(Debug, thiserror::Error)]
pub enum GradcheckError {
    /// The file cannot be read.
    #[error("{}: {source}", .file.display())]
    Read {
        /// The fixture.
        file: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file is not safetensors.
    #[error("{}: not a safetensors file: {reason}", .file.display())]
    Format {
        /// The fixture.
        file: PathBuf,
        /// The reason.
        reason: String,
    },
    /// A tensor is missing or invalid.
    #[error("{}: tensor `{tensor}`: {reason}", .file.display())]
    Tensor {
        /// The fixture.
        file: PathBuf,
        /// Name of the tensor.
        tensor: String,
        /// The reason.
        reason: String,
    },
    /// A metadata entry is invalid.
    #[error("{}: metadata `{key}`: {reason}", .file.display())]
    Metadata {
        /// The fixture.
        file: PathBuf,
        /// The entry.
        key: String,
        /// The reason.
        reason: String,
    },
    /// The ops refuse the scene.
    #[error("{}: {source}", .file.display())]
    Op {
        /// The fixture.
        file: PathBuf,
        /// The op's error.
        source: OpError,
    },
    /// The device cannot run the check.
    #[error("{}: {reason}", .file.display())]
    Device {
        /// The fixture.
        file: PathBuf,
        /// The reason.
        reason: String,
    },
}

/// Reads a fixture, renders it on a device, takes the gradients and judges them. A known [`Bug`]
/// can be switched on as a negative control.
///
/// # Errors
/// When the file is not a valid fixture, or the device or the ops refuse it. A wrong gradient is
/// not an error; it is a report with `pass` false.
pub fn check_file(
    path: &Path,
    device: &Device,
    precision: Precision,
    bug: Option<Bug>,
) -> Result<FileReport, GradcheckError> {
    check(&Fixture::read(path)?, device, precision, bug)
}

/// [`check_file`] for a fixture in memory.
///
/// In single precision, pixels that rounding may decide differently are excluded, see
/// [`FileReport::near_threshold`]. That needs double precision on the CPU; without the feature
/// `cpu`, every pixel counts.
///
/// # Errors
/// When the device or the ops refuse the scene.
pub fn check(
    fixture: &Fixture,
    device: &Device,
    precision: Precision,
    bug: Option<Bug>,
) -> Result<FileReport, GradcheckError> {
    #[cfg(feature = "cpu")]
    if precision == Precision::F32 {
        return left_out::check(fixture, device, bug);
    }
    let computed = run(&fixture.scene, device, precision, bug)?;
    let walk = walk(&fixture.scene, &computed, NEAR);
    Ok(compare(fixture, &computed, precision, walk.near_threshold))
}

#[cfg(all(test, feature = "cpu"))]
mod tests;
