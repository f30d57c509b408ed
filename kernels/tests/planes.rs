//! The kernels that use plane operations, run through the tests of `kernels/`. A process of its
//! own, as the choice is process-wide.

#[path = "kernels/adapter.rs"]
mod adapter;
#[path = "kernels/device.rs"]
mod device;
#[path = "kernels/rasterize.rs"]
mod rasterize;
#[allow(dead_code, reason = "the reference of the projection is not used here")]
#[path = "kernels/reference.rs"]
mod reference;
#[path = "kernels/sort.rs"]
mod sort;

/// True if kernels use plane operations.
const PLANES: bool = true;
