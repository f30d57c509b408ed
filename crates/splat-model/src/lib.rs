//! Gaussian splat models for Burn: the module, cameras, losses, density control, optimiser. Everything is an ordinary Burn module or a function on tensors.

mod adam;
mod camera;
pub mod density;
mod gaussians;
mod init;
pub mod losses;
mod rates;
mod render;

pub use adam::{EditLog, RowEdit, SplatAdam};
pub use camera::CameraTensors;
pub use gaussians::{Gaussians, ShPrecision};
pub use init::{InitError, InitSettings, splats_from_points};
pub use rates::{Field, LearningRates, splat_optimizer};
pub use render::{RenderSettings, project_gaussians, render, render_projected};
pub use splat_data::{Camera, SceneScale, SplatData};
pub use splat_ops as ops;
