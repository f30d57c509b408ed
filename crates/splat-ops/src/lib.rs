//! Gaussian splatting as differentiable Burn ops: tensors in, tensors out.
//!
//! ```text
//! means, quats, scales ──> project ──> Projected ─┐
//! SH coefficients, means, camera centres ──> sh_colors ──> colours ─┴─> rasterize ──> Rendered
//! ```
//!
//! | op | computes | differentiable in |
//! |---|---|---|
//! | [`project()`] | screen splats, as [`Projected`] | means, quats, scales, viewmats, intrinsics |
//! | [`sh_colors()`] | clamped view-dependent colours | coefficients, means, camera centres |
//! | [`spherical_harmonics()`] | the plain sum of spherical harmonics | coefficients, directions |
//! | [`rasterize()`] | image and alpha, as [`Rendered`] | splats, colours, opacities, background |
//! | [`photometric()`] | L1 and mean SSIM, as [`Photometric`] | the rendered image |
//! | [`photometric_masked`] | the same over the pixels that a mask keeps | the rendered image |
//! | [`ssim_map`] | SSIM per pixel and channel | both images |
//! | [`gaussian_blur`] | a separable symmetric window | the image |
//! | [`exp`], [`sigmoid`] | activations of scales and opacities | the input |
//! | [`adam_step`] | one step of Adam on one parameter | - |
//! | [`ScreenStatistics`] | sums for density control | - |
//! | [`Projected::with_absgrad`] | absolute screen gradients, a second result of `rasterize`'s backward pass | - |
//! | [`perturb_means`] | noise on the means, for MCMC | - |
//!
//! ```
//! use burn::tensor::{Device, Tensor};
//! use splat_ops::{
//!     ImageSize, ProjectSettings, RasterizeSettings, ScreenStatistics, project, rasterize, sh_colors,
//! };
//!
//! let device = Device::flex().autodiff();
//! let means = [[0.0, 0.0, 4.0], [0.5, 0.0, 6.0]];
//! let means = Tensor::<2>::from_floats(means, &device).require_grad();
//! let intrinsics = [[50.0, 50.0, 32.0, 24.0]];
//! let intrinsics = Tensor::<2>::from_floats(intrinsics, &device).require_grad();
//! let projected = project(
//!     means.clone(),
//!     Tensor::from_floats([[1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]], &device), // quats
//!     splat_ops::exp(Tensor::full([2, 3], -2.0, &device)),                        // scales
//!     Tensor::<2>::eye(4, &device).unsqueeze(),                                   // viewmats
//!     intrinsics.clone(),
//!     ImageSize { width: 64, height: 48 },
//!     &ProjectSettings::default(),
//! )?;
//! let (projected, probe) = projected.with_screen_probe();
//! let (sh0, centers) = (Tensor::zeros([2, 1, 3], &device), Tensor::zeros([1, 3], &device));
//! let colors = sh_colors(sh0, None, means.clone(), centers, 0, Some(&projected))?;
//! let opacities = splat_ops::sigmoid(Tensor::<1>::zeros([2], &device));
//! let rendered = rasterize(&projected, colors, opacities, None, &RasterizeSettings::default())?;
//!
//! // Gradients of the Gaussians and of the camera.
//! let gradients = rendered.image().mean().backward();
//! assert!(means.grad(&gradients).is_some());
//! assert!(intrinsics.grad(&gradients).is_some());
//!
//! // Statistics of the screen means, for density control.
//! let gradient = probe.grad(&gradients).unwrap();
//! let zeros = || Tensor::<1>::zeros([2], &gradient.device());
//! let sums = ScreenStatistics { gradients: zeros(), views: zeros() };
//! let sums = sums.add(gradient, &projected)?;
//! assert_eq!(sums.views.into_data().try_into_vec::<f32>().unwrap(), [1.0, 1.0]);
//! # Ok::<(), splat_ops::OpError>(())
//! ```
//!
//! The ops are separate so that anything can go between them: another colour model, another
//! opacity, another projection. Gradients are registered with Burn's autodiff and computed only for
//! inputs that it tracks. Each op has two implementations behind one trait
//! ([`backend::SplatBackend`]): CubeCL kernels for every CubeCL device (features `wgpu`, `vulkan`,
//! `cuda`), and native Rust for Burn's Flex backend (feature `cpu`; f32, and f64 as the reference).
//!
//! Every op and every gradient runs in a `tracing` span of its name, at level trace, on the
//! caller's thread. Without a subscriber, a span costs one load and one branch.
//!
//! # Conventions
//! - World and camera are right-handed; camera axes are +x right, +y down, +z forward (OpenCV,
//!   COLMAP). `viewmat` is world-to-camera, row-major 4x4.
//! - The centre of pixel (i, j) is at (i + 0.5, j + 0.5); intrinsics (fx, fy, cx, cy) are in
//!   pixels.
//! - Quaternions are (w, x, y, z) of any non-zero length; scales are linear and positive; opacities
//!   lie in (0, 1).
//! - Cameras are pinholes, or have the distortion of OpenCV's perspective or fisheye model
//!   ([`Intrinsics`], [`Lens`]).
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
mod intrinsics;
mod perturb;
mod photometric;
mod project;
mod rasterize;
mod screen_statistics;
mod sh_colors;
mod sh_starts;
mod spherical_harmonics;
mod ssim;
#[cfg(all(test, feature = "cpu"))]
mod tests;

pub use activation::{exp, sigmoid};
pub use adam::{adam_catch_up, adam_step, adam_step_groups};
pub use blur::gaussian_blur;
#[cfg(feature = "cpu")]
pub use cpu::RasterizeWork;
#[cfg(feature = "cube")]
pub use cubecl;
#[cfg(feature = "cpu")]
pub use device::rasterize_work;
pub use error::{ErrorSlot, OpError};
pub use intrinsics::{Distortion, Intrinsics};
pub use perturb::perturb_means;
pub use photometric::{Photometric, Target, photometric, photometric_masked};
pub use project::{Projected, project};
pub use rasterize::{Rendered, rasterize};
pub use screen_statistics::ScreenStatistics;
pub use settings::{
    Activation, AdamGap, AdamRows, AdamStep, CameraModel, ClampGradient, ImageSize, Perturbation,
    ProjectSettings, RasterizeSettings, RowGroups, ShColorSettings, SsimArgs,
};
pub use sh_colors::{ShRest, sh_colors};
pub use sh_starts::ShStarts;
pub use spherical_harmonics::{
    SH_DEGREE_MAX, sh_coefficient_count, sh_degree_of, spherical_harmonics,
};
pub use splat_core::{Lens, LensDomain};
pub use ssim::ssim_map;
