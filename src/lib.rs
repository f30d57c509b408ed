//! Differentiable Gaussian splatting for the [Burn](https://burn.dev) tensor framework.
//!
//! This crate only re-exports: [`ops`] are the differentiable ops (tensors in, tensors out),
//! [`model`] the Gaussians, cameras, losses, density control and files, [`train`] captures, the
//! training loop and evaluation. See the repository's `ARCHITECTURE.md` for what is where.
//!
//! ```no_run
//! use burn_splat::model::{Gaussians, files, render};
//! use burn_splat::train::{Capture, train::camera};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let device = burn::tensor::Device::flex();
//! let capture = Capture::load("examples/data/saharov".as_ref(), &Default::default())?;
//! let scene = files::ply::read("out/scene.ply".as_ref())?;
//! let gaussians = Gaussians::from_data(&scene, &device);
//! let view = camera(&capture.views[0]).tensors(&device);
//! let settings = scene.render_settings();
//! let image = render(&gaussians, &view, &settings)?.image(); // [1, H, W, 3]
//! # Ok(()) }
//! ```

pub use splat_model as model;
pub use splat_ops as ops;
pub use splat_trainer as train;
