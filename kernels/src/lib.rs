//! CubeCL kernels for Gaussian splatting, and nothing else: no tensor library.
//!
//! One file per stage, the forward pass beside its vector-Jacobian product, in the order of the
//! data's way: [`activation`], [`project`] and [`sh_colors`] (of spherical harmonics, [`sh`]) turn
//! Gaussians into screen splats and their colours; [`intersect`] lists which tiles every splat
//! touches, with [`scan`] and [`sort`]; [`rasterize`] blends each tile front to back;
//! [`photometric`] compares the image with a photo. [`adam`] and [`screen_statistics`] are what
//! else a training step does to every parameter and Gaussian. [`ssim`] is similarity pixel by
//! pixel, [`blur`] a window by itself, [`exp`] our own exponential. [`work`] counts what was
//! launched, [`floor`] says what it cannot do without, and [`copy`] how fast the device's memory
//! is.
//!
//! Functions take a CubeCL client and [`Buffer`]s of `f32` or `u32` (contiguous, row-major) and
//! launch kernels without waiting, except where they say so. The same input gives the same bits on
//! one device, unless a caller asks the rasteriser for sums without order ([`rasterize::Sums`]).

// `if comptime!(...)` decides while a kernel is built; joined to a condition on the device it would
// decide there.
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
pub mod photometric;
mod planes;
pub mod project;
pub mod rasterize;
mod reduce;
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
