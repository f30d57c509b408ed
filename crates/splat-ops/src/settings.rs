//! Sizes and settings of the ops. Every constant of the method is a field here, with its default.

pub use splat_core::{
    Activation, AdamRows, AdamStep, ClampGradient, ImageSize, ProjectSettings, RasterizeSettings,
    ShColorSettings, SsimArgs,
};

use crate::ErrorSlot;

/// Everything but tensors that a backend needs to project.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProjectArgs {
    /// Image size.
    pub size: ImageSize,
    /// Settings.
    pub settings: ProjectSettings,
}

/// Everything but tensors that a backend needs to rasterise.
#[derive(Debug, Clone)]
pub struct RasterizeArgs {
    /// Image size.
    pub size: ImageSize,
    /// Settings.
    pub settings: RasterizeSettings,
    /// Whether a backward pass follows: then there must be memory for it too.
    pub backward: bool,
    /// For what goes wrong on the way.
    pub errors: ErrorSlot,
}
