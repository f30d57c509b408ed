//! Errors of training runs.

use std::path::PathBuf;

use splat_data::CaptureError;
use splat_model::InitError;
use splat_ops::OpError;

use super::CheckpointError;

/// Why a run cannot start or continue.
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
        /// The problem with the points.
        source: InitError,
    },
    /// The scene is too small or too large for single precision.
    #[error(
        "{capture}: the scene is {size:.1e} units large, single precision has room for 1e-15 to 1e10; give cameras and points in another unit"
    )]
    SceneSize {
        /// The capture's folder.
        capture: PathBuf,
        /// Size of the scene, see [`SceneScale`](splat_model::SceneScale).
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
    /// The model, the strategy or a hook is unusable.
    #[error("{0}")]
    Setup(String),
    /// The run was interrupted before its first step, so that there is nothing to save.
    #[error(
        "interrupted before the first step, while the poses were adjusted; there is nothing to go on from"
    )]
    Interrupted,
    /// The loss has no terms, or does not depend on the rendered image.
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
        /// Value of the loss.
        value: f32,
        /// Number of such steps.
        in_a_row: usize,
    },
}
