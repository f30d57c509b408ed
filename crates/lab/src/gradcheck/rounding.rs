//! Rounding errors of alpha and transmittance in single precision.
//!
//! To first order, with u = 2^-24 the largest relative error of one rounding and k u that of a
//! chain of k roundings: four in a sum of four products; a quotient (2.5 units in the last place on
//! a GPU), a product and a sum; more than ten in the inverse Cholesky factor, from quaternion and
//! scales, and at most as many in the exponential.
//!
//! ```text
//! p = W mu + t          dp = 4 u (|W| |mu| + |t|), nothing where every product and sum is a single-precision number
//! m = f p.x / p.z + c, where the camera is a pinhole,
//!                       dm = |f / p.z| (dp.x + |p.x / p.z| dp.z) + 8 u |f p.x / p.z| + u |c|
//! z1 = w11 dx           dz1 = 16 u |w11 dx| + w11 dm.x
//! z2 = w21 dx + w22 dy  dz2 = 16 u (|w21 dx| + |w22 dy|) + |w21| dm.x + w22 dm.y
//! sigma = |z|^2 / 2     dsigma = |z1| dz1 + |z2| dz2 + (dz1^2 + dz2^2) / 2
//! alpha = o e^-sigma    dalpha = alpha (dsigma + 16 u min(sigma, 1))
//! T' = T (1 - alpha)    dT' = (1 - alpha) dT + T dalpha + 2 u T
//! ```
//!
//! Transmittance therefore loses 2 u and the errors of the alphas with every splat in front. Values
//! that are exact in any order of operations have no error: a mean on a pixel's centre has an alpha
//! of exactly its opacity, and 1/2 of 1/2 is 1/4.

use splat_ops::{CameraModel, Lens};

/// Largest relative error of rounding to single precision.
const UNIT: f64 = f32::EPSILON as f64 / 2.0;

/// Roundings in a camera-space coordinate, a sum of four products.
const SUM: f64 = 4.0;
/// Roundings from there to a screen mean.
const QUOTIENT: f64 = 8.0;
/// Roundings of the inverse Cholesky factor, its products, and the exponential.
const CHAIN: f64 = 16.0;

/// Error of a screen mean in pixels, from the Gaussian's mean, a row-major view matrix, fx, fy, cx,
/// cy and the lens.
pub(super) fn screen_mean(
    mean: &[f64],
    viewmat: &[f64],
    intrinsics: &[f64],
    lens: &Lens,
) -> [f64; 2] {
    let [(x, dx), (y, dy), (z, dz)] = [0, 4, 8].map(|row| {
        let row = &viewmat[row..row + 4];
        sum([row[0] * mean[0], row[1] * mean[1], row[2] * mean[2], row[3]])
    });
    if lens.model() != CameraModel::Pinhole {
        return bent_mean([x, y, z], [dx, dy, dz], intrinsics, lens);
    }
    let along = |p: f64, dp: f64, f: f64, c: f64| {
        let quotient = (f * p / z).abs();
        (f / z).abs() * (dp + (p / z).abs() * dz) + UNIT * (QUOTIENT * quotient + c.abs())
    };
    [
        along(x, dx, intrinsics[0], intrinsics[2]),
        along(y, dy, intrinsics[1], intrinsics[3]),
    ]
}

/// The same where a lens bends the way: the errors of the position through the lens's slopes, here
/// differences, and those of the lens's own formula, as many as of the whole chain.
fn bent_mean(p: [f64; 3], dp: [f64; 3], intrinsics: &[f64], lens: &Lens) -> [f64; 2] {
    let length = p.iter().map(|x| x * x).sum::<f64>().sqrt();
    let step = 1e-6 * length;
    let mut error = [0.0; 2];
    let Some(point) = lens.distort(p) else {
        return error;
    };
    for axis in 0..3 {
        let mut moved = p;
        moved[axis] += step;
        let there = lens.distort(moved).unwrap_or(point);
        for i in 0..2 {
            error[i] += ((there[i] - point[i]) / step).abs() * dp[axis];
        }
    }
    std::array::from_fn(|i| {
        let (f, c) = (intrinsics[i], intrinsics[2 + i]);
        f.abs() * (error[i] + CHAIN * UNIT * point[i].abs()) + UNIT * c.abs()
    })
}

/// A sum in order, with its error.
fn sum(terms: [f64; 4]) -> (f64, f64) {
    let (mut total, mut exact) = (0.0, true);
    for term in terms {
        total += term;
        exact &= is_single(term) && is_single(total);
    }
    let size: f64 = terms.iter().map(|term| term.abs()).sum();
    (total, if exact { 0.0 } else { SUM * UNIT * size })
}

/// Error of `alpha`, which is the opacity times `e^-sigma`, at (`dx`, `dy`) from the screen mean.
/// `mean` is the error of the screen mean, `factor` the inverse Cholesky factor, and `compensated`
/// true if the opacity itself was computed.
pub(super) fn alpha(
    alpha: f64,
    [dx, dy]: [f64; 2],
    [w11, w21, w22]: [f64; 3],
    mean: [f64; 2],
    compensated: bool,
) -> f64 {
    let chain = CHAIN * UNIT;
    let (z1, z2) = (w11 * dx, w21 * dx + w22 * dy);
    let dz1 = chain * z1.abs() + w11.abs() * mean[0];
    let dz2 =
        chain * ((w21 * dx).abs() + (w22 * dy).abs()) + w21.abs() * mean[0] + w22.abs() * mean[1];
    let sigma = (z1 * z1 + z2 * z2) / 2.0;
    let mut error = z1.abs() * dz1 + z2.abs() * dz2 + (dz1 * dz1 + dz2 * dz2) / 2.0;
    if sigma == 0.0 && error < UNIT / 2.0 {
        error = 0.0; // it rounds to e^0 = 1
    }
    error += chain * sigma.min(1.0);
    if compensated {
        error += chain;
    }
    alpha * error
}

/// Transmittance behind a splat of this `alpha`, with its error, from those before it and the error
/// of `alpha`.
pub(super) fn behind((before, error): (f64, f64), alpha: f64, alpha_error: f64) -> (f64, f64) {
    let left = before * (1.0 - alpha);
    let exact = error == 0.0 && alpha_error == 0.0 && is_single(left) && is_single(alpha * before);
    let rounding = if exact { 0.0 } else { 2.0 * UNIT * before };
    (
        left,
        (1.0 - alpha) * error + before * alpha_error + rounding,
    )
}

fn is_single(value: f64) -> bool {
    f64::from(value as f32) == value
}
