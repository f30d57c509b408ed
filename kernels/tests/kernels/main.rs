//! The kernels against the standard library and plain float64 references, on whatever wgpu adapter
//! is there. Those that can use plane operations do without them here; `planes.rs` beside this has
//! the others.

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

/// Whether kernels use plane operations.
const PLANES: bool = false;
