//! Sizes and settings of the ops. Every constant of the method is a field with a default.

pub use splat_core::{
    Activation, AdamGap, AdamRows, AdamStep, CameraModel, ClampGradient, ImageSize, Perturbation,
    ProjectSettings, RasterizeSettings, RowGroups, ShColorSettings, SsimArgs,
};

use crate::ErrorSlot;

/// Everything except tensors that a backend needs to project.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProjectArgs {
    /// Image size.
    pub size: ImageSize,
    /// Camera model of all cameras.
    pub model: CameraModel,
    /// Settings.
    pub settings: ProjectSettings,
}

/// Everything except tensors that a backend needs to rasterise.
#[derive(Debug, Clone)]
pub struct RasterizeArgs {
    /// Image size.
    pub size: ImageSize,
    /// Settings.
    pub settings: RasterizeSettings,
    /// True if a backward pass follows, which needs memory too.
    pub backward: bool,
    /// Receives errors of the backend.
    pub errors: ErrorSlot,
}
