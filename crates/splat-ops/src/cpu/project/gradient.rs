//! The vector-Jacobian product of the projection, for one Gaussian and one camera; without a branch, as its forward.

use super::super::math::*;
use super::super::real::Real;
use super::splat::{Camera, Gaussian, Splat};

/// Gradients of one (camera, Gaussian) pair.
pub(super) struct Gradient<T> {
    pub(super) mean: Vec3<T>,
    pub(super) quat: [T; 4],
    pub(super) scale: Vec3<T>,
    /// Of the camera's W and t.
    pub(super) w: Mat3<T>,
    pub(super) t: Vec3<T>,
    /// Of fx, fy, cx, cy.
    pub(super) intrinsics: [T; 4],
}

/// Given the gradient of the first seven columns of [`Splat::packed`]; the extents carry none.
#[inline(always)]
pub(super) fn splat_backward<T: Real>(
    g: Gaussian<T>,
    camera: &Camera<T>,
    s: &Splat<T>,
    grad: [T; 7],
) -> Gradient<T> {
    let half = T::of(0.5);
    let two = T::of(2.0);
    let (e, w11, w22) = (s.e, s.w11, s.w22);
    let compensation = s.packed[6];

    // Inverse Cholesky factor (packed in 1 / pixels, here in 1 / k) and compensation -> a, b, det, |m|.
    let (g11, g21, g22) = (grad[3] / s.k, grad[4] / s.k, grad[5] / s.k);
    let g22 = g22 - g21 * s.b / s.a;
    let db = -g21 * w22 / s.a;
    let da = (half * g22 * w22 - g21 * s.w21) / s.a - half * g11 * w11 * w11 * w11;
    let ddet = -half * (g22 * w22 + grad[6] * compensation) / s.det;
    let dlength = two * ddet * s.minors_length + grad[6] / s.det.sqrt();

    // a, b, det, |m| -> V. |m| has no derivative at zero; zero is its least subgradient.
    let dm = if s.minors_norm > T::ZERO {
        scale(s.minors, dlength / s.minors_norm)
    } else {
        [T::ZERO; 3]
    };
    // V in units of k -> V in pixels.
    let pixels = if s.flat { T::ZERO } else { T::ONE / s.k };
    let dv1 = add(
        add(scale(s.v1, two * (da + e * ddet)), scale(s.v2, db)),
        cross(s.v2, dm),
    );
    let dv2 = add(
        add(scale(s.v2, two * e * ddet), scale(s.v1, db)),
        cross(dm, s.v1),
    );
    let (dv1, dv2) = (scale(dv1, pixels), scale(dv2, pixels));

    // V = (J W R) diag(s) -> scales, R, J W.
    let dscale = add(hadamard(dv1, s.jwr[0]), hadamard(dv2, s.jwr[1]));
    let djwr = [hadamard(dv1, g.scale), hadamard(dv2, g.scale)];
    let drotation = add3(&outer(s.jw[0], djwr[0]), &outer(s.jw[1], djwr[1]));
    let djw = [apply(&s.rotation, djwr[0]), apply(&s.rotation, djwr[1])];

    // J W -> J, W.
    let [_, _, z] = s.p;
    let (fx, fy) = (camera.fx, camera.fy);
    let dj11 = dot(djw[0], camera.w[0]);
    let dj13 = dot(djw[0], camera.w[2]);
    let dj22 = dot(djw[1], camera.w[1]);
    let dj23 = dot(djw[1], camera.w[2]);
    let mut dw = [
        scale(djw[0], fx / z),
        scale(djw[1], fy / z),
        add(scale(djw[0], -fx * s.u / z), scale(djw[1], -fy * s.v / z)),
    ];

    // J -> fx, fy, u, v, z.
    let mut dfx = (dj11 - dj13 * s.u) / z;
    let mut dfy = (dj22 - dj23 * s.v) / z;
    let (mut dcx, mut dcy) = (grad[0], grad[1]);
    let du = -dj13 * fx / z;
    let dv = -dj23 * fy / z;
    let mut dz = grad[2] - (fx * (dj11 - dj13 * s.u) + fy * (dj22 - dj23 * s.v)) / (z * z);

    // Screen mean (not clamped) -> x/z, y/z.
    let (x_z, y_z) = (s.p[0] / z, s.p[1] / z);
    dfx += grad[0] * x_z;
    dfy += grad[1] * y_z;
    let (mut dx_z, mut dy_z) = (grad[0] * fx, grad[1] * fy);

    // Clamp: inside it passes on; outside u = const / fx - cx / fx is the camera's.
    if s.u_inside {
        dx_z += du;
    } else {
        dcx -= du / fx;
        dfx -= du * s.u / fx;
    }
    if s.v_inside {
        dy_z += dv;
    } else {
        dcy -= dv / fy;
        dfy -= dv * s.v / fy;
    }
    dz -= (dx_z * x_z + dy_z * y_z) / z;

    // p = W mean + t.
    let dp = [dx_z / z, dy_z / z, dz];
    dw = add3(&dw, &outer(dp, g.mean));
    Gradient {
        mean: apply_transposed(&camera.w, dp),
        quat: rotation_backward(s.unit, s.length, &drotation),
        scale: dscale,
        w: dw,
        t: dp,
        intrinsics: [dfx, dfy, dcx, dcy],
    }
}
