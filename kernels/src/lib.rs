//! CubeCL kernels for Gaussian splatting, independent of any tensor library.
//!
//! One file per stage, with the forward pass beside its vector-Jacobian product, in the order of
//! the pipeline. [`activation`], [`project`] and [`sh_colors`] (with [`sh`] for the harmonics) turn
//! Gaussians into screen splats and colours; [`intersect`] lists the tiles that each splat touches,
//! using [`scan`] and [`sort`]; [`rasterize`] blends each tile front to back; [`photometric`]
//! compares the image with a photo. [`adam`], [`screen_statistics`] and [`perturb`] complete a
//! training step. [`ssim`] is similarity per pixel, [`blur`] a separable window, [`exp`] the
//! exponential. [`work`] counts launches and memory, [`floor`] computes the unavoidable memory
//! traffic, and [`copy`] measures memory bandwidth.
//!
//! Functions take a CubeCL client and [`Buffer`]s of `f32` or `u32` (contiguous, row-major) and
//! launch kernels without waiting, unless documented otherwise. The same input gives the same bits
//! on one device, unless the caller asks the rasteriser for unordered sums ([`rasterize::Sums`]).

// `if comptime!(...)` is decided while a kernel is built; joined to a device condition it would be
// decided on the device.
#![allow(clippy::collapsible_if)]

pub mod activation;
pub mod adam;
pub mod blur;
mod bytes;
pub mod copy;
mod device_info;
pub mod exp;
pub mod floor;
pub mod intersect;
mod launch;
mod math;
pub mod perturb;
pub mod photometric;
mod planes;
pub mod project;
pub mod rasterize;
mod reduce;
mod row_groups;
pub mod scan;
pub mod screen_statistics;
pub mod sh;
pub mod sh_colors;
pub mod sort;
pub mod ssim;
mod work;

pub use device_info::device_info;
#[doc(hidden)]
pub use launch::poison;
pub use launch::{Buffer, CUBE_UNITS, HalfBuffer, MOST_BUFFERS, bindable_buffers, reads_half};
#[doc(hidden)]
pub use planes::force_plane_size;
pub use planes::plane_size;
pub use work::{Work, work};
