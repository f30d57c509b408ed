//! The kernels against the standard library and plain float64 references, on whatever wgpu adapter is there.

mod blur;
mod device;
mod exp;
mod intersect;
mod project;
mod rasterize;
mod reference;
mod scan;
mod sh;
mod sort;
