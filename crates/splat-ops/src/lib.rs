//! Gaussian splatting as differentiable Burn ops: tensors in, tensors out.
//!
//! ```text
//! means, quats, scales ──> project ──> Projected ─┐
//! SH coefficients, means, camera centres ──> sh_colors ──> colours ─┴─> rasterize ──> Rendered
//! ```
//!
//! The ops are separate so that anything can be put between them: another colour model, another
//! opacity, another projection. Each has a hand-written gradient, registered with Burn's autodiff,
//! and two implementations behind one trait ([`backend::SplatBackend`]): CubeCL kernels for every
//! CubeCL device (feature `wgpu`, `vulkan`, `cuda`) and native Rust for Burn's Flex backend
//! (feature `cpu`; f32, and f64 as the reference).
//!
//! Every op and every gradient runs in a `tracing` span of its name, level trace, on the caller's
//! thread: one load and a branch where nobody listens.
//!
//! # Conventions
//! - World and camera are right-handed; camera axes are +x right, +y down, +z forward (OpenCV,
//!   COLMAP). `viewmat` is world-to-camera, row-major 4x4.
//! - The centre of pixel (i, j) is at (i + 0.5, j + 0.5); intrinsics (fx, fy, cx, cy) are in
//!   pixels.
//! - Quaternions are (w, x, y, z) of any non-zero length; scales are linear and positive; opacities
//!   lie in (0, 1).
//! - C is the number of cameras, N of Gaussians, D of colour channels.

pub mod backend;
pub mod settings;

mod activation;
mod adam;
mod autodiff;
mod blur;
mod check;
mod composed;
#[cfg(feature = "cpu")]
pub mod cpu;
#[cfg(feature = "cube")]
mod cube;
pub mod device;
mod error;
mod photometric;
mod project;
mod rasterize;
mod screen_statistics;
mod sh_colors;
mod spherical_harmonics;
mod ssim;
#[cfg(all(test, feature = "cpu"))]
mod tests;

pub use activation::{exp, sigmoid};
pub use adam::adam_step;
pub use blur::gaussian_blur;
#[cfg(feature = "cpu")]
pub use cpu::RasterizeWork;
#[cfg(feature = "cube")]
pub use cubecl;
#[cfg(feature = "cpu")]
pub use device::rasterize_work;
pub use error::{ErrorSlot, OpError};
pub use photometric::{Photometric, Target, photometric, photometric_masked};
pub use project::{Projected, project};
pub use rasterize::{Rendered, rasterize};
pub use screen_statistics::ScreenStatistics;
pub use settings::{
    Activation, AdamRows, AdamStep, ClampGradient, ImageSize, ProjectSettings, RasterizeSettings,
    ShColorSettings, SsimArgs,
};
pub use sh_colors::sh_colors;
pub use spherical_harmonics::{SH_DEGREE_MAX, sh_coefficient_count, spherical_harmonics};
pub use ssim::ssim_map;
