//! Constants, layouts and settings that the kernels, the ops and the file readers agree on, and how much memory there is.
//! No dependencies.

pub mod memory;
mod packed;
mod settings;
mod sh;

pub use packed::{PROJECTED_EXTENT, PROJECTED_WIDTH};
pub use settings::{ClampGradient, ImageSize, ProjectSettings, RasterizeSettings, ShColorSettings};
pub use sh::{SH_C0, SH_DEGREE_MAX, sh_coefficient_count};
