//! Gaussian splat models for Burn: the module, cameras, losses, density control, optimiser, and
//! scene files. Everything is an ordinary Burn module or a function on tensors.

mod adam;
mod camera;
pub mod density;
pub mod files;
mod gaussians;
mod init;
pub mod losses;
mod rates;
mod render;
mod scene_scale;

pub use adam::{EditLog, RowEdit, SplatAdam};
pub use camera::{Camera, CameraTensors};
pub use gaussians::{Gaussians, ShPrecision};
pub use init::{InitError, InitSettings, splats_from_points};
pub use rates::{Field, LearningRates, splat_optimizer};
pub use render::{RenderSettings, project_gaussians, render, render_projected};
pub use scene_scale::SceneScale;
pub use splat_ops as ops;
