//! Ops composed of Burn's tensor ops, for backends that have nothing of their own, and for what their own do not cover:
//! other types than f32, windows too long for a workgroup's memory.

mod gaussians;
mod photometric;

pub(crate) use gaussians::*;
pub(crate) use photometric::*;
