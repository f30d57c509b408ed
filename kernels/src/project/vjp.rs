//! The vector-Jacobian product of the projection of one Gaussian to one camera.

use cubecl::prelude::*;
use splat_core::CameraModel;

use super::Uniforms;
use super::camera::{Camera, CameraGradient, SightGradient};
use super::splat::{Covariance, Gaussian, Splat};
use crate::math::{Mat3, Quat, Vec3};

/// Gradients of one projection, for its Gaussian and its camera.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Gradient {
    /// Gradients of the camera and of the mean.
    pub camera: CameraGradient,
    pub quat: Quat,
    pub scale: Vec3,
}

/// Gradients of the rows of V, in pixels, from the gradient of a packed splat that begins at `at`.
#[cube]
fn covariance_vjp(splat: Splat, grad_packed: &[f32], at: usize) -> (Vec3, Vec3) {
    let Covariance {
        k,
        m,
        e,
        a,
        b,
        det,
        v1,
        v2,
        ..
    } = splat.covariance;
    let w22 = splat.w22;
    // Packed in 1 / pixels, here in 1 / k.
    let g_w11 = grad_packed[at + 3] / k;
    let g_w21 = grad_packed[at + 4] / k;
    let g_compensation = grad_packed[at + 6];

    // w21 = -(b/a) w22,  w22 = √(a/det),  w11 = 1/√a,  compensation = |m|/√det
    let g_w22 = grad_packed[at + 5] / k - g_w21 * (b / a);
    let g_b = -g_w21 * (w22 / a);
    let g_a = g_w21 * (b / a) * (w22 / a) + 0.5f32 * (g_w22 * w22 - g_w11 * splat.w11) / a;
    let g_det = -0.5f32 * (g_w22 * w22 + g_compensation * splat.compensation) / det;
    // det = |m|² + e(|V1|² + |V2|²) + e²;  the gradient of |m| at 0 is 0
    let g_length = 2.0f32 * g_det * splat.covariance.m_length + g_compensation / f32::sqrt(det);
    let g_m = m.scale(g_length).over(splat.covariance.m_norm);
    // V in units of k -> V in pixels
    let pixels = select(splat.covariance.flat, 0.0f32, 1.0f32 / k);
    // m = V1 x V2,  a = |V1|² + e,  b = V1·V2
    let g_v1 = v2
        .cross(g_m)
        .add(v1.scale(2.0f32 * (e * g_det + g_a)))
        .add(v2.scale(g_b))
        .scale(pixels);
    let g_v2 = g_m
        .cross(v1)
        .add(v2.scale(2.0f32 * e * g_det))
        .add(v1.scale(g_b))
        .scale(pixels);
    (g_v1, g_v2)
}

/// Vector-Jacobian product of [`project_splat`](super::splat::project_splat), from the gradient at
/// `grad_packed[at..at + 7]` (extents carry none).
#[cube]
pub(super) fn project_vjp(
    g: Gaussian,
    camera: Camera,
    splat: Splat,
    grad_packed: &[f32],
    at: usize,
    s: Uniforms,
    #[comptime] model: CameraModel,
) -> Gradient {
    let (g_v1, g_v2) = covariance_vjp(splat, grad_packed, at);
    let Splat { sight, q, r, .. } = splat;

    // V = (J W R) diag(s)
    let g_scale = g_v1.mul(splat.jwr1).add(g_v2.mul(splat.jwr2));
    let g_jwr1 = g_v1.mul(g.scale);
    let g_jwr2 = g_v2.mul(g.scale);
    let g_r = Mat3 {
        r0: g_jwr1.scale(sight.jw1.x).add(g_jwr2.scale(sight.jw2.x)),
        r1: g_jwr1.scale(sight.jw1.y).add(g_jwr2.scale(sight.jw2.y)),
        r2: g_jwr1.scale(sight.jw1.z).add(g_jwr2.scale(sight.jw2.z)),
    };
    let g_quat = q.normalize_vjp(g.quat.length(), q.to_matrix_vjp(g_r));
    let g_sight = SightGradient {
        mean_x: grad_packed[at],
        mean_y: grad_packed[at + 1],
        depth: grad_packed[at + 2],
        jw1: r.mul_vec(g_jwr1),
        jw2: r.mul_vec(g_jwr2),
    };
    Gradient {
        camera: camera.sight_vjp(g.mean, sight, g_sight, s, model),
        quat: g_quat,
        scale: g_scale,
    }
}
