//! Common imports. The prelude includes the module `burn`, which Burn's derives refer to: after
//! `use burn_splat::prelude::*;`, `#[derive(Module)]` works in a crate with no other dependency.

pub use burn;
pub use burn::module::{Module, Param};
pub use burn::tensor::{Device, Gradients, Int, Tensor, TensorData};

pub use splat_data::{
    Camera, Capture, CaptureSettings, ImageSize, Lens, SceneScale, SplatData, View,
};
pub use splat_model::optimizer::{SplatAdam, StateRecord};
pub use splat_model::strategy::{
    Adc, AdcSettings, ImprovedGs, ImprovedGsSettings, Mcmc, McmcSettings, Refinement, ScreenWants,
    SelectionSettings, StepContext, StepInfo, Strategy,
};
pub use splat_model::{
    CameraTensors, Field, FieldStep, Gaussians, InitSettings, LearningRates, Moments, Optimized,
    RenderSettings, RowEdit, ShReductionSettings, SplatModel, losses, project_gaussians,
    reduce_sh_degrees, render, splats_from_points,
};
pub use splat_ops::{
    AdamRows, CameraModel, Distortion, Intrinsics, OpError, ProjectSettings, Projected,
    RasterizeSettings, Rendered, ShRest, ShStarts, project, rasterize, sh_colors,
};
pub use splat_trainer::calibration::CalibrationSettings;
pub use splat_trainer::{
    Hook, HookView, LossTerms, StrategyKind, TargetView, TrainSettings, Trained, Trainer, evaluate,
};
