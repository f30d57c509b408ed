//! Constants, layouts and settings shared by the kernels, the ops and the file readers, and a
//! measure of available memory. No dependencies.

pub mod angle;
pub mod exp;
mod lens;
pub mod memory;
pub mod noise;
mod packed;
mod row_groups;
mod settings;
mod sh;
mod tensors;

pub use lens::{BoundedLens, CameraModel, Lens, LensDomain};
pub use packed::{PROJECTED_DEPTH, PROJECTED_EXTENT, PROJECTED_WIDTH, SPLAT_SIZE_MAX, TILE_SIDE};
pub use row_groups::RowGroups;
pub use settings::{
    ALPHA_MIN, Activation, AdamGap, AdamRows, AdamStep, ClampGradient, ImageSize, Perturbation,
    ProjectSettings, RasterizeSettings, ShColorSettings, SsimArgs,
};
pub use sh::{SH_C0, SH_C1, SH_C2, SH_C3, SH_DEGREE_MAX, sh_coefficient_count, sh_degree_of};
pub use tensors::{
    AdamTensors, PerturbTensors, ProjectTensors, RasterizeTensors, ScreenStatisticsTensors,
    ShColorTensors, SphericalHarmonicsTensors, SsimTensors,
};
