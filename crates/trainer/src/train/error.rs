//! Why a run cannot begin or go on.

use std::path::PathBuf;

use splat_data::CaptureError;
use splat_model::InitError;
use splat_ops::OpError;

use super::CheckpointError;

/// Why a run could not go on.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// The capture has nothing to train on.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// The points cannot start a scene.
    #[error("{capture}: {source}")]
    Init {
        /// The capture's folder.
        capture: PathBuf,
        /// What is wrong with them.
        source: InitError,
    },
    /// The scene is too small or too large for single precision.
    #[error(
        "{capture}: the scene is {size:.1e} units large, single precision has room for 1e-15 to 1e10; give cameras and points in another unit"
    )]
    SceneSize {
        /// The capture's folder.
        capture: PathBuf,
        /// Its size, see [`SceneScale`](splat_model::SceneScale).
        size: f64,
    },
    /// A setting is out of range.
    #[error("configuration: {0}")]
    Config(String),
    /// The checkpoint to resume from is not usable.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// An op refused its input.
    #[error(transparent)]
    Op(#[from] OpError),
    /// The model, the strategy or a hook cannot be used as they are.
    #[error("{0}")]
    Setup(String),
    /// The loss has no term, or does not depend on what was rendered.
    #[error("the loss {0}")]
    Loss(&'static str),
    /// The loss stays NaN or infinite.
    #[error(
        "step {step}: the loss is {value} on view {view}, and was not finite for {in_a_row} steps in a row; lower the learning rates, or look at the photos, their cameras and the loss"
    )]
    NotFinite {
        /// The last of these steps, from 1.
        step: usize,
        /// Name of its photo.
        view: String,
        /// Its loss.
        value: f32,
        /// How many they are.
        in_a_row: usize,
    },
}
