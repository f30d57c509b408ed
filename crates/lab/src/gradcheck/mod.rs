//! Gradient checks: a scene with known gradients (a fixture) against our ops on any device.
//!
//! ```text
//! *.safetensors ──fixture──> scene, expected ──run──> rendered, gradients ──judge──> FileReport ──report──> table, JSON
//! ```
//!
//! In single precision, pixels on a threshold of blending are left out (`left_out.rs`).
//!
//! The fixtures come from PyTorch in float64 (`tests/fixtures/generate.py`); any framework can
//! write one. [`check_file`] does it all for one file.

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

/// Floating point type that a check runs in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Precision {
    /// Single precision, on every device.
    F32,
    /// Double precision, on the CPU (Flex) device only.
    F64,
}

impl Precision {
    /// Burn's name for it.
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

/// What keeps a fixture from being checked. Every message names the file.
#[derive(Debug, thiserror::Error)]
pub enum GradcheckError {
    /// The file cannot be read.
    #[error("{}: {source}", .file.display())]
    Read {
        /// The fixture.
        file: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is not safetensors.
    #[error("{}: not a safetensors file: {reason}", .file.display())]
    Format {
        /// The fixture.
        file: PathBuf,
        /// Why.
        reason: String,
    },
    /// A tensor is missing or does not fit.
    #[error("{}: tensor `{tensor}`: {reason}", .file.display())]
    Tensor {
        /// The fixture.
        file: PathBuf,
        /// Its name in the file.
        tensor: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A metadata entry does not fit.
    #[error("{}: metadata `{key}`: {reason}", .file.display())]
    Metadata {
        /// The fixture.
        file: PathBuf,
        /// The entry.
        key: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The ops refuse the scene.
    #[error("{}: {source}", .file.display())]
    Op {
        /// The fixture.
        file: PathBuf,
        /// Why.
        source: OpError,
    },
    /// The device cannot run the check.
    #[error("{}: {reason}", .file.display())]
    Device {
        /// The fixture.
        file: PathBuf,
        /// Why.
        reason: String,
    },
}

/// Reads a fixture, renders it on a device, takes the gradients and judges them; with a known
/// [`Bug`] switched on as a negative control.
///
/// # Errors
/// When the file is not a valid fixture, or the device or the ops refuse it. A wrong gradient is no
/// error: it is a report with `pass` false.
pub fn check_file(
    path: &Path,
    device: &Device,
    precision: Precision,
    bug: Option<Bug>,
) -> Result<FileReport, GradcheckError> {
    check(&Fixture::read(path)?, device, precision, bug)
}

/// [`check_file`] on a fixture in memory.
///
/// In single precision the pixels that rounding may decide differently are left out, see
/// [`FileReport::near_threshold`]. That takes double precision on the CPU: built without the
/// feature `cpu`, every pixel counts.
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
