//! Small algebra for kernels. Methods instead of operators, because `#[cube]` expands method calls.

mod guard;
mod mat;
mod quat;
mod vec;

pub(crate) use guard::*;
pub(crate) use mat::*;
pub(crate) use quat::*;
pub(crate) use vec::*;
