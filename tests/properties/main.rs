//! Properties of every scene, on the CPU, tested on random ones (proptest, fixed seeds).
//!
//! - `invariance`: changes that leave the image unchanged, and their effect on the gradients.
//! - `blending`: properties of the rasteriser's colours, alpha and transmittance.
//! - `differences`: the gradient of each op, by central differences.
#![cfg(feature = "cpu")]

mod blending;
mod differences;
mod invariance;
mod scene;
mod support;
