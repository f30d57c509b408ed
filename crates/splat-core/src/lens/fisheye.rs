//! The equidistant lens with a polynomial of the angle, in double precision.

use super::polynomial::{crossing, first_root, value};

/// Largest angle from the axis: at 180 degrees all directions are one, and the picture a ring.
const WIDEST: f64 = 175.0 / 180.0 * core::f64::consts::PI;

/// Beyond a photo a lens is no more than so many times as steep as in it.
const STEEPER: f64 = 2.0;
/// Angles of a photo at which its slope is looked at.
const SAMPLES: u32 = 64;

/// Distance from the axis on the image plane, of a direction at this angle.
fn bend(k: &[f64; 4], theta: f64) -> f64 {
    let [k1, k2, k3, k4] = *k;
    theta * value(&[1.0, k1, k2, k3, k4], theta * theta)
}

/// Derivative of [`bend`], a polynomial of the squared angle.
fn slope(k: &[f64; 4]) -> [f64; 5] {
    let [k1, k2, k3, k4] = *k;
    [1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4]
}

/// The smallest angle at which the distance on the image plane stops to grow.
pub(super) fn limit(k: &[f64; 4]) -> f64 {
    first_root(&slope(k), WIDEST * WIDEST).map_or(WIDEST, f64::sqrt)
}

/// The angle beyond that of a photo's farthest corner, and up to a limit, at which the slope is
/// [`STEEPER`] than anywhere in the photo. The polynomial was fitted to the photo; where it runs
/// away, a splat beside or behind the camera would cover the picture.
pub(super) fn steep(k: &[f64; 4], corner: f64, limit: f64) -> f64 {
    let mut slope = slope(k);
    let angles = (0..=SAMPLES).map(|i| corner * f64::from(i) / f64::from(SAMPLES));
    let slopes = angles.map(|theta| value(&slope, theta * theta));
    slope[0] -= STEEPER * slopes.fold(0.0, f64::max);
    first_root(&slope, limit * limit).map_or(limit, |q| q.sqrt().max(corner))
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
