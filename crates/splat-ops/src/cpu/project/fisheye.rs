//! The equidistant lens with a polynomial of the angle (OpenCV's fisheye model).
//!
//! With R = |p|, (nx, ny, nz) = p / R, t the angle from the axis, h = t / sin t and the polynomial
//! P = 1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8:
//!
//! ```text
//! a' = s nx, b' = s ny          s = h P
//! J = (1/R) [s + e nx^2,  e nx ny,     -m nx]          m = d(t P)/dt = P + t P'
//!           [e nx ny,     s + e ny^2,  -m ny]          e = (m cos t - s) / sin^2 t
//! ```
//!
//! All of s, e and m are smooth functions of t^2, and so are their derivatives divided by t, on
//! which the gradient stands: nothing is divided by the distance from the axis. Where the closed
//! forms cancel, near the axis, they are series. A dot is a derivative by t divided by t:
//!
//! ```text
//! h. = (1 - h cos t) / (h sin^2 t)          h.. = (1 - 3 h. cos t - h.^2 sin^2 t) / (h sin^2 t)
//! e = h (h. cos t - 1) P + h^2 cos t P.     (cos t). = -1 / h
//! ```

use core::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI};

use splat_core::angle::{ATAN_ABOVE, ATAN_BELOW, ATAN_REDUCED, CURVATURE, SERIES_END, SLOPE};

use super::super::math::*;
use super::super::real::Real;
use super::camera::COEFFICIENTS;
use super::distorted::{Bend, Plane};

/// Coefficients and domain.
#[derive(Clone, Copy)]
pub(super) struct OpenCvFisheye<T> {
    k: [T; 4],
    /// Largest angle.
    limit: T,
}

/// A direction and the functions of its angle.
struct Bent<T> {
    /// 1 / R.
    over: T,
    n: Vec3<T>,
    angle: T,
    /// t^2 and h.
    u: T,
    h: T,
    /// h. and h..
    slope: T,
    curvature: T,
    /// P, P. and P..
    p: [T; 3],
    s: T,
    e: T,
    m: T,
}

/// The polynomial with these coefficients, the highest power first.
#[inline(always)]
fn horner<T: Real>(coefficients: impl Iterator<Item = f64>, x: T) -> T {
    coefficients.fold(T::ZERO, |sum, c| sum * x + T::of(c))
}

/// The angle from the axis, of a point at `z` along it and at distance `rho >= 0`.
#[inline(always)]
fn angle<T: Real>(rho: T, z: T) -> T {
    let ahead = z.abs();
    let steep = rho > ahead;
    // Both are computed, so that lanes need no branch.
    let ratio = rho.least(ahead) / rho.greatest(ahead);
    let reduced = ratio > T::of(ATAN_REDUCED);
    let shifted = (ratio - T::ONE) / (ratio + T::ONE);
    let x = if reduced { shifted } else { ratio };
    let start = if reduced { FRAC_PI_4 } else { 0.0 };
    let square = x * x;
    let above = horner(ATAN_ABOVE.into_iter(), square);
    let below = horner(ATAN_BELOW.into_iter(), square);
    let angle = T::of(start) + (x + x * square * (above / below));
    let complement = T::of(FRAC_PI_2) - angle;
    let angle = if steep { complement } else { angle };
    let behind = T::of(PI) - angle;
    if z < T::ZERO { behind } else { angle }
}

impl<T: Real> OpenCvFisheye<T> {
    #[inline(always)]
    fn bend(&self, [x, y, z]: Vec3<T>) -> Bent<T> {
        let [k1, k2, k3, k4] = self.k;
        let t = |value: f64| T::of(value);
        let across = x * x + y * y;
        let rho = across.sqrt();
        let over = T::ONE / (across + z * z).sqrt();
        let n = scale([x, y, z], over);
        let (sin, cos) = (rho * over, n[2]);
        let angle = angle(rho, z);
        let u = angle * angle;
        let h = if sin > T::ZERO { angle / sin } else { T::ONE };

        let near = u < T::of(SERIES_END);
        let below = h * sin * sin;
        // Both are computed, so that lanes need no branch.
        let series = horner(SLOPE.into_iter().rev(), u);
        let closed = (T::ONE - h * cos) / below;
        let slope = if near { series } else { closed };
        let series = horner(CURVATURE.into_iter().rev(), u);
        let closed = (T::ONE - t(3.0) * slope * cos - slope * slope * sin * sin) / below;
        let curvature = if near { series } else { closed };

        let p = [
            T::ONE + u * (k1 + u * (k2 + u * (k3 + u * k4))),
            t(2.0) * k1 + u * (t(4.0) * k2 + u * (t(6.0) * k3 + u * t(8.0) * k4)),
            t(8.0) * k2 + u * (t(24.0) * k3 + u * t(48.0) * k4),
        ];
        Bent {
            over,
            n,
            angle,
            u,
            h,
            slope,
            curvature,
            p,
            s: h * p[0],
            e: h * (slope * cos - T::ONE) * p[0] + h * h * cos * p[1],
            m: p[0] + u * p[1],
        }
    }
}

impl<T: Real> Bend<T> for OpenCvFisheye<T> {
    const COEFFICIENTS: usize = 4;

    fn new(k: &[T], domain: &[T]) -> Self {
        Self {
            k: [k[0], k[1], k[2], k[3]],
            limit: domain[0],
        }
    }

    #[inline(always)]
    fn plane(&self, p: Vec3<T>) -> Plane<T> {
        let Bent {
            over,
            n: [nx, ny, _],
            angle,
            s,
            e,
            m,
            ..
        } = self.bend(p);
        Plane {
            point: [s * nx, s * ny],
            depth: T::ONE / over,
            inside: angle < self.limit,
            jacobian: [
                scale([s + e * nx * nx, e * nx * ny, -m * nx], over),
                scale([e * nx * ny, s + e * ny * ny, -m * ny], over),
            ],
        }
    }

    #[inline(always)]
    fn plane_backward(
        &self,
        p: Vec3<T>,
        [ga, gb]: [T; 2],
        ddepth: T,
        [g1, g2]: Mat23<T>,
    ) -> (Vec3<T>, [T; COEFFICIENTS]) {
        let two = T::of(2.0);
        let bent = self.bend(p);
        let Bent {
            over,
            n: [nx, ny, cos],
            u,
            h,
            slope,
            curvature,
            p: [p0, p1, p2],
            s,
            e,
            m,
            ..
        } = bent;

        // Point and Jacobian -> s, e, m, n, R.
        let crossed = g1[1] + g2[0];
        let ds = ga * nx + gb * ny + over * (g1[0] + g2[1]);
        let de = over * (nx * nx * g1[0] + nx * ny * crossed + ny * ny * g2[1]);
        let dm = -over * (nx * g1[2] + ny * g2[2]);
        let dnx = ga * s + over * (two * e * nx * g1[0] + e * ny * crossed - m * g1[2]);
        let dny = gb * s + over * (two * e * ny * g2[1] + e * nx * crossed - m * g2[2]);
        let jacobian = s * over * (g1[0] + g2[1]) + e * de + m * dm;

        // s, e, m -> the angle; derivatives divided by it.
        let turn = slope * cos - T::ONE;
        let dot_s = slope * p0 + h * p1;
        let dot_e = (slope * turn + h * (curvature * cos - slope / h)) * p0
            + h * turn * p1
            + (two * h * slope * cos - h) * p1
            + h * h * cos * p2;
        let dot_m = T::of(3.0) * p1 + u * p2;
        let dt = ds * dot_s + de * dot_e + dm * dot_m;

        // The angle by p is (cos x/rho, cos y/rho, -sin) / R, times the angle (h cos nx, h cos ny,
        // -h sin^2) / R; R and n by p.
        let sin2 = nx * nx + ny * ny;
        let radial = nx * dnx + ny * dny;
        let dp = [
            over * (dnx - nx * radial + dt * h * cos * nx - jacobian * nx) + ddepth * nx,
            over * (dny - ny * radial + dt * h * cos * ny - jacobian * ny) + ddepth * ny,
            over * (-cos * radial - dt * h * sin2 - jacobian * cos) + ddepth * cos,
        ];

        // P = .. + kj t^2j, P. = .. + 2j kj t^(2j-2).
        let dp0 = ds * h + de * h * turn + dm;
        let dp1 = de * h * h * cos + dm * u;
        let mut dk = [T::ZERO; COEFFICIENTS];
        let mut power = T::ONE;
        for (j, dk) in dk.iter_mut().take(4).enumerate() {
            *dk = power * (dp0 * u + dp1 * T::of(2.0 * (j as f64 + 1.0)));
            power = power * u;
        }
        (dp, dk)
    }
}
