//! Differentiable Gaussian splatting for the [Burn](https://burn.dev) tensor framework.
//!
//! This is the only dependency a crate needs: Burn itself is re-exported, and the [`prelude`] has
//! what most programs use.
//!
//! ```
//! use burn_splat::prelude::*;
//!
//! let device = Device::flex();
//! let settings = CaptureSettings::new().with_downscale(16);
//! let capture = Capture::load("examples/data/saharov", &settings)?;
//! let camera = capture.views[0].camera();
//! let trained = Trainer::builder(capture)
//!     .settings(TrainSettings::new().with_steps(3))
//!     .device(device.clone())
//!     .build()?
//!     .run()?;
//! let camera = camera.relative_to(trained.model.origin);
//! let camera = CameraTensors::from_camera(&camera, &device);
//! let image = render(&trained.model, &camera, &RenderSettings::new())?.image(); // [1, H, W, 3]
//! assert_eq!(image.dims()[3], 3);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Ops
//!
//! Tensors in, tensors out, each with a hand-written gradient. [`ops`] states the conventions.
//!
//! | op | computes |
//! |---|---|
//! | [`ops::project()`] | screen splats of 3D Gaussians, with gradients of poses, intrinsics and distortion |
//! | [`ops::sh_colors()`] | clamped view-dependent colours from spherical harmonics |
//! | [`ops::spherical_harmonics()`] | the plain sum of spherical harmonics |
//! | [`ops::rasterize()`] | an image of any number of channels, and alpha |
//! | [`ops::photometric()`] | L1 and SSIM of an image and a photo, in one pass |
//! | [`ops::photometric_masked`] | the same over the pixels that a mask keeps |
//! | [`ops::ssim_map`] | SSIM per pixel and channel |
//! | [`ops::gaussian_blur`] | a separable symmetric window |
//! | [`ops::adam_step`] | one step of Adam on one parameter |
//! | [`ops::exp`], [`ops::sigmoid`] | the activations of scales and opacities |
//! | [`ops::ScreenStatistics`] | per-Gaussian sums for density control |
//! | [`ops::Projected::with_absgrad`] | absolute screen gradients (AbsGS) |
//! | [`ops::perturb_means`] | noise on the means, for MCMC |
//!
//! # Types
//!
//! | type | is |
//! |---|---|
//! | [`Gaussians`](model::Gaussians) | the model of 3DGS, a Burn module |
//! | [`SplatModel`](model::SplatModel) | the trait of every model that can be rendered and trained |
//! | [`CameraTensors`](model::CameraTensors) | cameras as differentiable tensors |
//! | [`render`](model::render()) | the three ops composed |
//! | [`Optimized`](model::Optimized) | a model with the optimisers of its fields |
//! | [`RowEdit`](model::RowEdit) | an edit of the rows of a model, moments included |
//! | [`Strategy`](model::strategy::Strategy) | the trait of density control; [`Adc`](model::strategy::Adc), [`Mcmc`](model::strategy::Mcmc), [`ImprovedGs`](model::strategy::ImprovedGs) |
//! | [`reduce_sh_degrees`](model::reduce_sh_degrees) | lower degrees of spherical harmonics for Gaussians whose colours hardly depend on the view |
//! | [`losses`](model::losses) | L1, MSE, PSNR and SSIM on tensors |
//! | [`Capture`](data::Capture), [`Camera`](data::Camera) | photos with their cameras and points |
//! | [`SplatData`](data::SplatData), [`scene`](data::scene) | a scene as plain arrays, and its files |
//! | [`SceneScale`](data::SceneScale) | the size of a scene, from which every length follows |
//! | [`Trainer`](train::Trainer) | the training loop |
//! | [`LossTerms`](train::LossTerms) | a loss of named, weighted terms |
//! | [`Hook`](train::Hook) | the trait of modules trained beside the model |
//! | [`evaluate`](train::evaluate()) | PSNR and SSIM of held-out views |
//!
//! The feature `lab` adds the module `lab`: gradient checks and measurements.
//!
//! The repository's `ARCHITECTURE.md` describes the crates, and `examples/` has a short program per
//! task.

pub use burn;
pub use splat_data as data;
pub use splat_data::glam;
#[cfg(feature = "lab")]
pub use splat_lab as lab;
pub use splat_model as model;
pub use splat_ops as ops;
#[cfg(any(feature = "wgpu", feature = "cuda"))]
pub use splat_ops::cubecl;
pub use splat_trainer as train;

pub mod prelude;
