//! The vector-Jacobian product of the projection, for one Gaussian and one camera. Branch-free,
//! like the forward pass.

use super::super::math::*;
use super::super::real::Real;
use super::camera::{Camera, CameraGradient, Lens};
use super::splat::{Gaussian, Splat};

/// Gradients of one (camera, Gaussian) pair.
pub(super) struct Gradient<T> {
    /// Gradients of the camera and of the mean.
    pub(super) camera: CameraGradient<T>,
    pub(super) quat: [T; 4],
    pub(super) scale: Vec3<T>,
}

/// From the gradient of the first seven columns of [`Splat::packed`]; the extents carry none.
#[inline(always)]
pub(super) fn splat_backward<T: Real, L: Lens<T>>(
    g: Gaussian<T>,
    camera: &Camera<T, L>,
    s: &Splat<T, L::Kept>,
    grad: [T; 7],
) -> Gradient<T> {
    let half = T::of(0.5);
    let two = T::of(2.0);
    let (e, w11, w22) = (s.e, s.w11, s.w22);
    let compensation = s.packed[6];

    // Inverse Cholesky factor (packed in 1 / pixels, here in 1 / k) and compensation -> a, b, det,
    // |m|.
    let (g11, g21, g22) = (grad[3] / s.k, grad[4] / s.k, grad[5] / s.k);
    let g22 = g22 - g21 * s.b / s.a;
    let db = -g21 * w22 / s.a;
    let da = (half * g22 * w22 - g21 * s.w21) / s.a - half * g11 * w11 * w11 * w11;
    let ddet = -half * (g22 * w22 + grad[6] * compensation) / s.det;
    let dlength = two * ddet * s.minors_length + grad[6] / s.det.sqrt();

    // a, b, det, |m| -> V. |m| is not differentiable at zero; zero is its least subgradient.
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
    let drotation = add3(
        &outer(s.sight.jw[0], djwr[0]),
        &outer(s.sight.jw[1], djwr[1]),
    );
    let djw = [apply(&s.rotation, djwr[0]), apply(&s.rotation, djwr[1])];

    let [mean_x, mean_y, depth, ..] = grad;
    Gradient {
        camera: camera.sight_backward(g.mean, &s.sight, [mean_x, mean_y, depth], djw),
        quat: rotation_backward(s.unit, s.length, &drotation),
        scale: dscale,
    }
}
