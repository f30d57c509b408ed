//! Readers that are no part of the library's face, for fuzz targets.

use std::path::Path;

pub use crate::capture::in_memory::parse as parse_capture;
use crate::cli::{self, Failure};
use crate::train::TrainConfig;

/// Settings of a run from the content of a `config.toml`; `path` is for messages.
///
/// # Errors
/// When it is not such a file.
pub fn parse_config(path: &Path, bytes: &[u8]) -> Result<TrainConfig, Failure> {
    cli::parse_config(path, bytes)
}
