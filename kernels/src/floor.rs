//! The bytes of device memory that a training step cannot do without: every stage reads each of its
//! inputs and writes each of its results once, with a perfect cache within a stage and none between
//! stages.
//!
//! Each stage states its own beside its kernels (`floor`); here they are put together for one
//! camera. Counted are the kernels of this crate alone, not the tensor ops between them. Two
//! estimates are in it: the lists of all tiles count to their ends, also where all pixels stop
//! earlier; and what is said per Gaussian counts all of them, also those out of view, but for the
//! colours, which leave those out. Neither is a bound that a kernel could not go below by knowing
//! more than its input.

pub use crate::bytes::{Bytes, Sizes};
use crate::{
    activation, adam, intersect, photometric, project, rasterize, screen_statistics, sh_colors,
    sort,
};

impl Sizes {
    pub(crate) fn pixels(&self) -> u64 {
        self.width * self.height
    }
}

/// The stages of a step by name, in order, and the floor of each.
pub fn step(sizes: &Sizes) -> Vec<(&'static str, Bytes)> {
    let [activations, activations_gradient] = activation::floor(sizes);
    let [project, project_gradient] = project::floor(sizes);
    let [colours, colours_gradient] = sh_colors::floor(sizes);
    let [blend, blend_gradient] = rasterize::floor(sizes);
    let [photometric, photometric_gradient] = photometric::floor(sizes);
    vec![
        ("activations", activations),
        ("project", project),
        ("colours", colours),
        (
            "rasterize",
            intersect::floor(sizes) + sort::floor(sizes) + blend,
        ),
        ("photometric", photometric),
        ("photometric gradient", photometric_gradient),
        ("rasterize gradient", blend_gradient),
        ("colours gradient", colours_gradient),
        ("project gradient", project_gradient),
        ("activations gradient", activations_gradient),
        ("adam", adam::floor(sizes)),
        ("density", screen_statistics::floor(sizes)),
    ]
}
