//! What most programs use. It has the module `burn` too, which Burn's derives name: with `use
//! burn_splat::prelude::*;` `#[derive(Module)]` works in a crate that depends on nothing else.

pub use burn;
pub use burn::module::{Module, Param};
pub use burn::tensor::{Device, Int, Tensor, TensorData};

pub use splat_data::{Camera, Capture, CaptureSettings, ImageSize, SceneScale, SplatData, View};
pub use splat_model::{CameraTensors, Gaussians, RenderSettings, losses, render};
pub use splat_ops::{OpError, Projected, Rendered, project, rasterize, sh_colors};
pub use splat_trainer::{LossTerms, TargetView, TrainSettings, Trained, Trainer, evaluate};
