//! Ops composed of Burn's tensor ops, for backends without an implementation of their own and for
//! inputs that theirs does not cover: types other than f32, windows too long for shared memory.

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
