//! Gaussian splat models for Burn: the module, cameras, losses, density control, optimiser, scene files.

pub mod files;
