//! Differentiable Gaussian splatting for the [Burn](https://burn.dev) tensor framework.
//!
//! The only dependency that a crate needs: Burn itself is re-exported, and the [`prelude`] has what
//! most programs use. [`ops`] are the differentiable ops (tensors in, tensors out), [`model`] the
//! Gaussians, cameras, losses, strategies and optimisers, [`data`] captures and scene files,
//! [`train`] the training loop and evaluation, and with the feature `lab` `lab` has the gradient
//! checks and measurements. See the repository's `ARCHITECTURE.md` for what is where.
//!
//! ```no_run
//! use burn_splat::data::scene::ply;
//! use burn_splat::prelude::*;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let device = Device::flex();
//! let capture = Capture::load("examples/data/saharov", &Default::default())?;
//! let scene = ply::read("out/scene.ply")?;
//! let gaussians = Gaussians::from_data(&scene, &device);
//! let camera = CameraTensors::from_camera(&capture.views[0].camera(), &device);
//! let image = render(&gaussians, &camera, &RenderSettings::of_scene(&scene))?.image(); // [1, H, W, 3]
//! # Ok(()) }
//! ```

pub use burn;
pub use splat_data as data;
#[cfg(feature = "lab")]
pub use splat_lab as lab;
pub use splat_model as model;
pub use splat_ops as ops;
#[cfg(any(feature = "wgpu", feature = "cuda"))]
pub use splat_ops::cubecl;
pub use splat_trainer as train;

pub mod prelude;
