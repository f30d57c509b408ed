//! The perspective lens with radial and tangential distortion, in double precision.

use super::polynomial::{crossing, derivative, first_root, product, value};

/// Radius up to which a lens that never folds back is defined.
const FARTHEST: f64 = 1e6;

/// The lens at a point of the undistorted plane: the distorted point, and its Jacobian by that
/// point, which is symmetric: d a'/d a, d a'/d b = d b'/d a, d b'/d b.
struct Bent {
    point: [f64; 2],
    jacobian: [f64; 3],
}

fn bend(k: &[f64; 8], [a, b]: [f64; 2]) -> Bent {
    let [k1, k2, p1, p2, k3, k4, k5, k6] = *k;
    let q = a * a + b * b;
    let above = [1.0, k1, k2, k3];
    let below = [1.0, k4, k5, k6];
    let denominator = value(&below, q);
    let l = value(&above, q) / denominator;
    let slope = (value(&derivative(&above), q) - l * value(&derivative(&below), q)) / denominator;
    Bent {
        point: [
            a * l + 2.0 * p1 * a * b + p2 * (q + 2.0 * a * a),
            b * l + p1 * (q + 2.0 * b * b) + 2.0 * p2 * a * b,
        ],
        jacobian: [
            l + 2.0 * a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a,
            2.0 * a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b,
            l + 2.0 * b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a,
        ],
    }
}

/// The smallest radius at which r L(r) stops to grow, or L has a pole.
pub(super) fn limit(k: &[f64; 8]) -> f64 {
    let [k1, k2, _, _, k3, k4, k5, k6] = *k;
    let above = [1.0, k1, k2, k3];
    let below = [1.0, k4, k5, k6];
    // d(r L)/dr = (N D + 2 q (N' D - N D')) / D^2 with L = N/D, polynomials of q = r^2.
    let turning = {
        let mut sum = product(&above, &below);
        let rising = product(&derivative(&above), &below);
        let falling = product(&above, &derivative(&below));
        for (power, (rising, falling)) in rising.iter().zip(&falling).enumerate() {
            sum[power + 1] += 2.0 * (rising - falling);
        }
        sum
    };
    let end = FARTHEST * FARTHEST;
    let roots = [first_root(&turning, end), first_root(&below, end)];
    roots
        .into_iter()
        .flatten()
        .fold(f64::INFINITY, f64::min)
        .sqrt()
        .min(FARTHEST)
}

fn is_defined(limit: f64, [a, b]: [f64; 2], jacobian: [f64; 3]) -> bool {
    let [d11, d12, d22] = jacobian;
    a.hypot(b) < limit && d11 * d22 - d12 * d12 > 0.0
}

/// The distorted point, where the lens is defined.
pub(super) fn distort(k: &[f64; 8], limit: f64, point: [f64; 2]) -> Option<[f64; 2]> {
    let bent = bend(k, point);
    is_defined(limit, point, bent.jacobian).then_some(bent.point)
}

/// The undistorted point: the radius by bisection, then Newton's method for the tangential part.
pub(super) fn undistort(k: &[f64; 8], limit: f64, [a, b]: [f64; 2]) -> Option<[f64; 2]> {
    let distorted = a.hypot(b);
    if distorted == 0.0 && k[2] == 0.0 && k[3] == 0.0 {
        return Some([0.0, 0.0]);
    }
    let radial = {
        let [k1, k2, _, _, k3, k4, k5, k6] = *k;
        [k1, k2, 0.0, 0.0, k3, k4, k5, k6]
    };
    let end = limit * (1.0 - 1e-12);
    let radius = crossing(|r| bend(&radial, [r, 0.0]).point[0] - distorted, 0.0, end);
    // Tangential distortion can bring in what is just outside.
    let scale = radius.unwrap_or(if distorted > 0.0 { end } else { 0.0 }) / distorted.max(1e-300);
    let mut guess = [a * scale, b * scale];
    for _ in 0..50 {
        let bent = bend(k, guess);
        let [d11, d12, d22] = bent.jacobian;
        let determinant = d11 * d22 - d12 * d12;
        let (da, db) = (a - bent.point[0], b - bent.point[1]);
        let step = [
            (d22 * da - d12 * db) / determinant,
            (d11 * db - d12 * da) / determinant,
        ];
        guess = [guess[0] + step[0], guess[1] + step[1]];
        if !(guess[0].is_finite() && guess[1].is_finite()) {
            return None;
        }
        if step[0].hypot(step[1]) <= 1e-15 * guess[0].hypot(guess[1]) {
            break;
        }
    }
    let bent = bend(k, guess);
    let missed = (bent.point[0] - a).hypot(bent.point[1] - b);
    (missed <= 1e-9 * (1.0 + distorted) && is_defined(limit, guess, bent.jacobian)).then_some(guess)
}
