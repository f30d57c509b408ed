//! Text files that a user may have edited.

use std::path::Path;

use super::Failure;
use splat_data::text::utf8;
use splat_trainer::TrainSettings;

/// Reads a file and parses its text, without a byte-order mark; errors name the file.
pub(super) fn read<T>(
    path: &Path,
    parse: impl FnOnce(&str) -> Result<T, String>,
) -> Result<T, Failure> {
    let named = |reason: String| Failure::BadInput(format!("{}: {reason}", path.display()));
    let bytes = std::fs::read(path).map_err(|error| named(error.to_string()))?;
    utf8(&bytes).and_then(parse).map_err(named)
}

/// Reads a run's settings.
pub(super) fn read_config(path: &Path) -> Result<TrainSettings, Failure> {
    read(path, |text| TrainSettings::parse(text.as_bytes()))
}
