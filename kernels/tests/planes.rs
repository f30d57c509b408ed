//! The kernels that use plane operations, by the tests of `kernels/`. A process of its own: the
//! choice is for all.

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

/// Whether kernels use plane operations.
const PLANES: bool = true;
