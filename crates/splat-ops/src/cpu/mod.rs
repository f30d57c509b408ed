//! Native Rust for Burn's Flex backend: f32, and f64 as the reference.
//!
//! Runs in parallel over Gaussians or rows of tiles with rayon. Deterministic: sums across threads
//! have a fixed order, so the same input gives the same bits on any number of threads.

/// Calls a generic function in the precision of a tensor. The public ops accept only F32 and F64.
macro_rules! in_precision {
    ($tensor:expr, $function:path, $($argument:expr),* $(,)?) => {
        match $tensor.dtype() {
            burn::tensor::DType::F64 => $function(core::marker::PhantomData::<f64>, $($argument),*),
            _ => $function(core::marker::PhantomData::<f32>, $($argument),*),
        }
    };
}

mod activation;
mod adam;
mod awake;
mod blur;
pub(crate) mod buffer;
mod instructions;
mod intersect;
mod math;
mod overwritten;
mod perturb;
mod photometric;
#[cfg(test)]
pub(crate) mod poison;
mod project;
mod rasterize;
pub(crate) mod real;
mod row_groups;
mod schedule;
mod screen_statistics;
mod sh_colors;
mod simd;
mod spherical_harmonics;
mod splat;
mod ssim;
mod tiles;
mod uninit;

pub(crate) use awake::keep_awake;
pub use instructions::InstructionSet;

pub use rasterize::{RasterizeWork, rasterize_work};
