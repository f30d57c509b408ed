//! The equidistant lens with a polynomial of the angle, in double precision.

use super::polynomial::{crossing, first_root, value};

/// Largest angle from the axis: at 180 degrees all directions are one, and the picture a ring.
const WIDEST: f64 = 175.0 / 180.0 * core::f64::consts::PI;

/// Distance from the axis on the image plane, of a direction at this angle.
fn bend(k: &[f64; 4], theta: f64) -> f64 {
    let [k1, k2, k3, k4] = *k;
    theta * value(&[1.0, k1, k2, k3, k4], theta * theta)
}

/// The smallest angle at which the distance on the image plane stops to grow.
pub(super) fn limit(k: &[f64; 4]) -> f64 {
    let [k1, k2, k3, k4] = *k;
    let slope = [1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4];
    first_root(&slope, WIDEST * WIDEST).map_or(WIDEST, f64::sqrt)
}

/// The distorted point, where the lens is defined.
pub(super) fn distort(k: &[f64; 4], limit: f64, [x, y, z]: [f64; 3]) -> Option<[f64; 2]> {
    let rho = x.hypot(y);
    let theta = rho.atan2(z);
    if !(theta < limit) {
        return None;
    }
    let scale = if rho > 0.0 {
        bend(k, theta) / rho
    } else {
        1.0 / z
    };
    Some([x * scale, y * scale])
}

/// The direction, of length 1.
pub(super) fn undistort(k: &[f64; 4], limit: f64, [a, b]: [f64; 2]) -> Option<[f64; 3]> {
    let distorted = a.hypot(b);
    if distorted == 0.0 {
        return Some([0.0, 0.0, 1.0]);
    }
    let theta = crossing(|theta| bend(k, theta) - distorted, 0.0, limit)?;
    let (sin, cos) = theta.sin_cos();
    Some([sin * a / distorted, sin * b / distorted, cos])
}
