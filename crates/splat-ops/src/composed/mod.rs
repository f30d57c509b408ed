//! Ops composed of Burn's tensor ops, for backends that have nothing of their own, and for what
//! their own do not cover: other types than f32, windows too long for a workgroup's memory.

mod activation;
#[cfg(feature = "cube")]
mod photometric;
#[cfg(feature = "cpu")]
mod ssim;

pub(crate) use activation::*;
#[cfg(feature = "cube")]
pub(crate) use photometric::*;
#[cfg(feature = "cpu")]
pub(crate) use ssim::*;
