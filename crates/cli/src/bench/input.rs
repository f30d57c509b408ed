//! Input of the speed benches: a capture.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clap::Args;

use super::{Failure, GlobalArgs};
use crate::photos::PhotoArgs;
use splat_data::Capture;
use splat_trainer::TrainSettings;

/// The capture shipped with the project.
pub(super) const EXAMPLE: &str = "examples/data/saharov";

/// The capture, and the time to measure.
#[derive(Debug, Clone, Args)]
pub(super) struct CaptureArgs {
    #[command(flatten)]
    pub(super) photos: PhotoArgs,
    /// Measure each setting for about this many seconds, and at least once
    #[arg(long, value_name = "S", default_value_t = 10.0)]
    pub(super) seconds: f64,
}

impl CaptureArgs {
    /// Reads a capture, by default the project's example.
    pub(super) fn open(
        &self,
        folder: Option<&Path>,
        global: &GlobalArgs,
    ) -> Result<Arc<Capture>, Failure> {
        let folder = folder.map_or_else(|| PathBuf::from(EXAMPLE), Path::to_owned);
        let capture = self.photos.open(&folder, global)?;
        capture.check_trainable()?;
        Ok(Arc::new(capture))
    }

    /// The default settings, with the requested changes.
    pub(super) fn config(&self, global: &GlobalArgs) -> TrainSettings {
        TrainSettings {
            downscale: self.photos.options().downscale,
            seed: global.seed.unwrap_or_default(),
            ..TrainSettings::default()
        }
    }

    /// The options as typed, each with a leading space.
    pub(super) fn typed(&self) -> String {
        let words = self.photos.words();
        let words = words.iter().map(|word| format!(" {}", word.display()));
        words.collect()
    }
}
