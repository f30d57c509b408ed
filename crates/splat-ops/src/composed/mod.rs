//! Ops composed of Burn's tensor ops, for backends that have nothing of their own.

mod gaussians;
mod photometric;

pub(crate) use gaussians::*;
pub(crate) use photometric::*;
