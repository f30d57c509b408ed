//! Common imports. The prelude includes the module `burn`, which Burn's derives refer to: after
//! `use burn_splat::prelude::*;`, `#[derive(Module)]` works in a crate with no other dependency.

pub use burn;
pub use burn::module::{Module, Param};
pub use burn::tensor::{Device, Gradients, Int, Tensor, TensorData};

pub use splat_data::{Camera, Capture, CaptureSettings, ImageSize, SceneScale, SplatData, View};
pub use splat_model::optimizer::{SplatAdam, StateRecord};
pub use splat_model::strategy::{Refinement, ScreenWants, StepContext, StepInfo, Strategy};
pub use splat_model::{
    CameraTensors, Field, FieldStep, Gaussians, LearningRates, Moments, Optimized, RenderSettings,
    RowEdit, SplatModel, losses, render,
};
pub use splat_ops::{
    OpError, ProjectSettings, Projected, RasterizeSettings, Rendered, project, rasterize, sh_colors,
};
pub use splat_trainer::{
    Hook, HookView, LossTerms, TargetView, TrainSettings, Trained, Trainer, evaluate,
};
