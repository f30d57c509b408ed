//! Device memory traffic that a training step cannot avoid: each stage reads each of its inputs and
//! writes each of its results once, with a perfect cache within a stage and none between stages.
//!
//! Each stage states its own floor beside its kernels (`floor`); this file combines them for one
//! camera. Only the kernels of this crate are counted, not the tensor ops between them. Two figures
//! are estimates: the lists of all tiles count to their ends, even if all pixels stop earlier; and
//! per-Gaussian figures count all Gaussians, including those out of view, except for the colours. A
//! kernel that knew more than its input could go below both.

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

/// Stages of a step by name, in order, with the floor of each.
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
