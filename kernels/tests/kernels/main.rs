//! The kernels, compared with the standard library and plain float64 references on the wgpu adapter
//! found. Kernels that can use plane operations do without them here; `planes.rs` tests the others.

mod activation;
mod adam;
mod adapter;
mod blur;
mod device;
mod exp;
mod intersect;
mod photometric;
mod project;
mod rasterize;
mod reference;
mod scan;
mod sh;
mod sh_colors;
mod sort;

/// True if kernels use plane operations.
const PLANES: bool = false;
