//! The equidistant lens with a polynomial of the angle (OpenCV's fisheye model).
//!
//! With R = |p|, (nx, ny, nz) = p / R, t the angle from the axis, h = t / sin t and the polynomial
//! P = 1 + k1 t² + k2 t⁴ + k3 t⁶ + k4 t⁸:
//!
//! ```text
//! a' = s nx, b' = s ny          s = h P
//! J = (1/R) [s + e nx²,  e nx ny,    -m nx]          m = d(t P)/dt = P + t P'
//!           [e nx ny,    s + e ny²,  -m ny]          e = (m cos t - s) / sin² t
//! ```
//!
//! All of s, e and m are smooth functions of t², and so are their derivatives divided by t, on
//! which the gradient stands: nothing is divided by the distance from the axis. Where the closed
//! forms cancel, near the axis, they are series. A dot is a derivative by t divided by t:
//!
//! ```text
//! h. = (1 - h cos t) / (h sin² t)           h.. = (1 - 3 h. cos t - h.² sin² t) / (h sin² t)
//! e = h (h. cos t - 1) P + h² cos t P.      (cos t). = -1 / h
//! ```
//!
//! The arc tangent is a polynomial of our own, because shading languages allow theirs an error of
//! 4096 units in the last place.

use cubecl::prelude::*;
use splat_core::angle::{
    ATAN_ABOVE, ATAN_BELOW, ATAN_REDUCED, CURVATURE, SERIES_END, SINGLE, SLOPE,
};

use super::camera::{Coefficients, Lens};
use super::distorted::{LensGradient, Plane, PlaneGradient};
use crate::math::Vec3;

const QUARTER: f32 = core::f32::consts::FRAC_PI_4;
const HALF: f32 = core::f32::consts::FRAC_PI_2;
const WHOLE: f32 = core::f32::consts::PI;

/// A direction and the functions of its angle.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Bent {
    /// 1 / R.
    over: f32,
    n: Vec3,
    angle: f32,
    /// t² and h.
    u: f32,
    h: f32,
    /// h. and h..
    slope: f32,
    curvature: f32,
    /// P, P. and P..
    p0: f32,
    p1: f32,
    p2: f32,
    s: f32,
    e: f32,
    m: f32,
}

/// The angle from the axis, of a point at `z` along it and at distance `rho >= 0`.
#[cube]
fn angle(rho: f32, z: f32) -> f32 {
    let ahead = f32::abs(z);
    let ratio = min(rho, ahead) / max(max(rho, ahead), 1e-30f32);
    let reduced = ratio > comptime!(ATAN_REDUCED as f32);
    let x = select(reduced, (ratio - 1.0f32) / (ratio + 1.0f32), ratio);
    let start = select(reduced, QUARTER, 0.0f32);
    let square = x * x;
    let mut above = 0.0f32;
    #[unroll]
    for i in 0..5usize {
        above = above * square + comptime!(ATAN_ABOVE[i] as f32);
    }
    let mut below = 0.0f32;
    #[unroll]
    for i in 0..6usize {
        below = below * square + comptime!(ATAN_BELOW[i] as f32);
    }
    let angle = start + (x + x * square * (above / below));
    let angle = select(rho > ahead, HALF - angle, angle);
    select(z < 0.0f32, WHOLE - angle, angle)
}

#[cube]
fn bend(k: Coefficients, p: Vec3) -> Bent {
    let across = p.x * p.x + p.y * p.y;
    let rho = f32::sqrt(across);
    let over = 1.0f32 / f32::sqrt(across + p.z * p.z);
    let n = p.scale(over);
    let sin = rho * over;
    let cos = n.z;
    let angle = angle(rho, p.z);
    let u = angle * angle;
    let h = select(sin > 0.0f32, angle / max(sin, 1e-30f32), 1.0f32);

    let near = u < comptime!(SERIES_END as f32);
    let mut slope_series = 0.0f32;
    let mut curvature_series = 0.0f32;
    #[unroll]
    for i in 0..SINGLE {
        slope_series = slope_series * u + comptime!(SLOPE[SINGLE - 1 - i] as f32);
        curvature_series = curvature_series * u + comptime!(CURVATURE[SINGLE - 1 - i] as f32);
    }
    let below = select(near, 1.0f32, h * sin * sin);
    let slope = select(near, slope_series, (1.0f32 - h * cos) / below);
    let curvature = select(
        near,
        curvature_series,
        (1.0f32 - 3.0f32 * slope * cos - slope * slope * sin * sin) / below,
    );

    let p0 = 1.0f32 + u * (k.c0 + u * (k.c1 + u * (k.c2 + u * k.c3)));
    let p1 = 2.0f32 * k.c0 + u * (4.0f32 * k.c1 + u * (6.0f32 * k.c2 + u * 8.0f32 * k.c3));
    let p2 = 8.0f32 * k.c1 + u * (24.0f32 * k.c2 + u * 48.0f32 * k.c3);
    Bent {
        over,
        n,
        angle,
        u,
        h,
        slope,
        curvature,
        p0,
        p1,
        p2,
        s: h * p0,
        e: h * (slope * cos - 1.0f32) * p0 + h * h * cos * p1,
        m: p0 + u * p1,
    }
}

#[cube]
pub(super) fn fisheye_plane(lens: Lens, p: Vec3) -> Plane {
    let bent = bend(lens.k, p);
    let Bent { n, s, e, m, .. } = bent;
    Plane {
        a: s * n.x,
        b: s * n.y,
        depth: 1.0f32 / bent.over,
        inside: bent.angle < lens.limit,
        n1: Vec3::new(s + e * n.x * n.x, e * n.x * n.y, -m * n.x).scale(bent.over),
        n2: Vec3::new(e * n.x * n.y, s + e * n.y * n.y, -m * n.y).scale(bent.over),
    }
}

/// Vector-Jacobian product of [`fisheye_plane`].
#[cube]
pub(super) fn fisheye_vjp(lens: Lens, p: Vec3, g: PlaneGradient) -> LensGradient {
    let bent = bend(lens.k, p);
    let Bent {
        over,
        n,
        u,
        h,
        slope,
        curvature,
        p0,
        p1,
        p2,
        s,
        e,
        m,
        ..
    } = bent;
    let cos = n.z;

    // Point and Jacobian -> s, e, m, n, R.
    let crossed = g.n1.y + g.n2.x;
    let trace = g.n1.x + g.n2.y;
    let g_s = g.a * n.x + g.b * n.y + over * trace;
    let g_e = over * (n.x * n.x * g.n1.x + n.x * n.y * crossed + n.y * n.y * g.n2.y);
    let g_m = -over * (n.x * g.n1.z + n.y * g.n2.z);
    let g_nx = g.a * s + over * (2.0f32 * e * n.x * g.n1.x + e * n.y * crossed - m * g.n1.z);
    let g_ny = g.b * s + over * (2.0f32 * e * n.y * g.n2.y + e * n.x * crossed - m * g.n2.z);
    let jacobian = s * over * trace + e * g_e + m * g_m;

    // s, e, m -> the angle; derivatives divided by it.
    let turn = slope * cos - 1.0f32;
    let dot_s = slope * p0 + h * p1;
    let dot_e = (slope * turn + h * (curvature * cos - slope / h)) * p0
        + h * turn * p1
        + (2.0f32 * h * slope * cos - h) * p1
        + h * h * cos * p2;
    let dot_m = 3.0f32 * p1 + u * p2;
    let g_t = g_s * dot_s + g_e * dot_e + g_m * dot_m;

    // The angle by p, times the angle: (h cos nx, h cos ny, -h sin²) / R. R and n by p.
    let radial = n.x * g_nx + n.y * g_ny;
    let shared = g_t * h * cos - radial - jacobian;
    let sin2 = n.x * n.x + n.y * n.y;

    // P = .. + kj t^2j, P. = .. + 2j kj t^(2j-2).
    let g_p0 = g_s * h + g_e * h * turn + g_m;
    let g_p1 = g_e * h * h * cos + g_m * u;
    LensGradient {
        p: Vec3::new(
            over * (g_nx + n.x * shared) + g.depth * n.x,
            over * (g_ny + n.y * shared) + g.depth * n.y,
            over * (-cos * (radial + jacobian) - g_t * h * sin2) + g.depth * cos,
        ),
        k: Coefficients {
            c0: g_p0 * u + 2.0f32 * g_p1,
            c1: (g_p0 * u + 4.0f32 * g_p1) * u,
            c2: (g_p0 * u + 6.0f32 * g_p1) * u * u,
            c3: (g_p0 * u + 8.0f32 * g_p1) * u * u * u,
            c4: 0.0f32,
            c5: 0.0f32,
            c6: 0.0f32,
            c7: 0.0f32,
        },
    }
}
