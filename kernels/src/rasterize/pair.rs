//! One splat at one pixel: what it is there, and what becomes of it.

use cubecl::prelude::*;

use super::RasterizeSettings;
use crate::exp::exp2_neg;
use crate::intersect::Frames;

/// `exp(-sigma) = 2^-t` with t this times `|z|^2`.
const HALF_LOG2_E: f32 = 0.5 * core::f32::consts::LOG2_E;

/// Floats of a splat in shared memory: mean x, y, w11, w21, w22, opacity. Its colours follow.
pub(super) const SHAPE: usize = 6;

/// Mean, inverse Cholesky factor and opacity of a splat.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Shape {
    pub mean_x: f32,
    pub mean_y: f32,
    pub w11: f32,
    pub w21: f32,
    pub w22: f32,
    pub opacity: f32,
}

#[cube]
impl Shape {
    /// That which begins at `at`.
    pub fn load(splats: &[f32], at: usize) -> Shape {
        Shape {
            mean_x: splats[at],
            mean_y: splats[at + 1],
            w11: splats[at + 2],
            w21: splats[at + 3],
            w22: splats[at + 4],
            opacity: splats[at + 5],
        }
    }
}

/// A splat at a pixel.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Sample {
    pub dx: f32,
    pub dy: f32,
    pub z1: f32,
    pub z2: f32,
    /// o exp(-sigma), not capped.
    pub raw: f32,
}

/// A splat at the pixel centre (x, y). Forward and backward both decide on this; fused
/// multiply-adds are spelled out so that both are rounded alike.
#[cube]
pub(super) fn sample(shape: Shape, x: f32, y: f32) -> Sample {
    let dx = x - shape.mean_x;
    let dy = y - shape.mean_y;
    let z1 = shape.w11 * dx;
    let z2 = fma(shape.w21, dx, shape.w22 * dy);
    Sample {
        dx,
        dy,
        z1,
        z2,
        raw: shape.opacity * exp2_neg(HALF_LOG2_E * fma(z2, z2, z1 * z1)),
    }
}

/// Alpha of a pair that is not to be looked at: less than every threshold.
pub(super) const UNSEEN: f32 = -1.0;

/// The one place that decides what becomes of a (pixel, splat) pair; both passes ask it.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Thresholds {
    alpha_min: f32,
    alpha_max: f32,
    transmittance_min: f32,
}

#[cube]
impl Thresholds {
    pub fn seen(self, raw: f32) -> bool {
        raw >= self.alpha_min
    }

    pub fn alpha(self, raw: f32) -> f32 {
        min(self.alpha_max, raw)
    }

    /// At the cap alpha no longer depends on anything.
    pub fn capped(self, raw: f32) -> bool {
        raw >= self.alpha_max
    }

    pub fn stops(self, transmittance_after: f32) -> bool {
        transmittance_after < self.transmittance_min
    }
}

pub(super) fn thresholds(frames: &Frames, settings: &RasterizeSettings) -> ThresholdsLaunch {
    ThresholdsLaunch::new(
        frames.alpha_min,
        settings.alpha_max,
        settings.transmittance_min,
    )
}
