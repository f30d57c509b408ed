//! Properties that hold for every scene, on the CPU, checked on random ones (proptest, fixed
//! seeds).
//!
//! - `invariance`: what may change without changing the picture, and how the gradients follow.
//! - `blending`: what the rasteriser promises of colours, alpha and transmittance.
//! - `differences`: the gradient of each op by central differences.
#![cfg(feature = "cpu")]

mod blending;
mod differences;
mod invariance;
mod scene;
mod support;
