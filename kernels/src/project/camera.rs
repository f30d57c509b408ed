//! One camera: its projection of a point, and the vector-Jacobian product of that. The camera model
//! is known when a kernel is compiled, so that a pinhole pays nothing for the others.

use cubecl::prelude::*;
use splat_core::CameraModel;

use super::Uniforms;
use super::distorted::{distorted_sight, distorted_vjp};
use super::pinhole::{pinhole_sight, pinhole_vjp};
use crate::math::{Mat3, Vec3};

/// W, t, the intrinsics and the lens of one camera.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Camera {
    pub w: Mat3,
    pub t: Vec3,
    pub fx: f32,
    pub fy: f32,
    pub cx: f32,
    pub cy: f32,
    pub lens: Lens,
}

/// Coefficients and domain of a lens; zero, and read by nothing, for a pinhole.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Lens {
    pub k: Coefficients,
    /// Largest radius or angle.
    pub limit: f32,
    /// Radius of the clamp.
    pub clamp: f32,
}

/// Coefficients of a lens in their order: k1, k2, p1, p2, k3, k4, k5, k6 of `opencv`, and k1, k2,
/// k3, k4 of `opencv_fisheye`. Or their gradients.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Coefficients {
    pub c0: f32,
    pub c1: f32,
    pub c2: f32,
    pub c3: f32,
    pub c4: f32,
    pub c5: f32,
    pub c6: f32,
    pub c7: f32,
}

/// A point in a camera, with the camera linearised there.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Sight {
    /// Position in camera space.
    pub p: Vec3,
    pub mean_x: f32,
    pub mean_y: f32,
    /// By which splats are culled and sorted.
    pub depth: f32,
    /// True if the lens is defined there.
    pub inside: bool,
    /// Rows of J W.
    pub jw1: Vec3,
    pub jw2: Vec3,
}

/// Gradients of the fields of a [`Sight`].
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct SightGradient {
    pub mean_x: f32,
    pub mean_y: f32,
    pub depth: f32,
    pub jw1: Vec3,
    pub jw2: Vec3,
}

/// Gradients of one camera through one point, and of that point.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct CameraGradient {
    pub mean: Vec3,
    pub w: Mat3,
    pub t: Vec3,
    pub fx: f32,
    pub fy: f32,
    pub cx: f32,
    pub cy: f32,
    pub k: Coefficients,
}

#[cube]
impl Coefficients {
    /// All zero.
    pub fn zero() -> Coefficients {
        Coefficients {
            c0: 0.0f32,
            c1: 0.0f32,
            c2: 0.0f32,
            c3: 0.0f32,
            c4: 0.0f32,
            c5: 0.0f32,
            c6: 0.0f32,
            c7: 0.0f32,
        }
    }
}

/// One value, or zero if there are none.
#[cube]
fn value_or_zero(values: &ComptimeOption<&[f32]>, at: usize) -> f32 {
    let mut found = 0.0f32;
    #[comptime]
    if let ComptimeOption::Some(values) = values {
        found += values[at];
    }
    found
}

#[cube]
impl Lens {
    fn load(
        distortion: &ComptimeOption<&[f32]>,
        domain: &ComptimeOption<&[f32]>,
        index: usize,
        #[comptime] model: CameraModel,
    ) -> Lens {
        let mut k = Coefficients::zero();
        let width = comptime!(model.coefficients());
        let at = index * width;
        if comptime!(width > 0) {
            k.c0 = value_or_zero(distortion, at);
            k.c1 = value_or_zero(distortion, at + 1);
            k.c2 = value_or_zero(distortion, at + 2);
            k.c3 = value_or_zero(distortion, at + 3);
        }
        if comptime!(width > 4) {
            k.c4 = value_or_zero(distortion, at + 4);
            k.c5 = value_or_zero(distortion, at + 5);
            k.c6 = value_or_zero(distortion, at + 6);
            k.c7 = value_or_zero(distortion, at + 7);
        }
        let limit = value_or_zero(domain, index * 2);
        let clamp = value_or_zero(domain, index * 2 + 1);
        Lens { k, limit, clamp }
    }
}

#[cube]
impl Camera {
    pub fn load(
        viewmats: &[f32],
        intrinsics: &[f32],
        distortion: &ComptimeOption<&[f32]>,
        domain: &ComptimeOption<&[f32]>,
        index: usize,
        #[comptime] model: CameraModel,
    ) -> Camera {
        let m = index * 16;
        let i = index * 4;
        Camera {
            w: Mat3 {
                r0: Vec3::load(viewmats, m),
                r1: Vec3::load(viewmats, m + 4),
                r2: Vec3::load(viewmats, m + 8),
            },
            t: Vec3::new(viewmats[m + 3], viewmats[m + 7], viewmats[m + 11]),
            fx: intrinsics[i],
            fy: intrinsics[i + 1],
            cx: intrinsics[i + 2],
            cy: intrinsics[i + 3],
            lens: Lens::load(distortion, domain, index, model),
        }
    }

    pub fn sight(self, mean: Vec3, s: Uniforms, #[comptime] model: CameraModel) -> Sight {
        let p = self.w.mul_vec(mean).add(self.t);
        if comptime!(model == CameraModel::Pinhole) {
            pinhole_sight(self, p, s)
        } else {
            distorted_sight(self, p, model)
        }
    }

    /// Vector-Jacobian product of [`Camera::sight`] at `mean`.
    pub fn sight_vjp(
        self,
        mean: Vec3,
        sight: Sight,
        g: SightGradient,
        s: Uniforms,
        #[comptime] model: CameraModel,
    ) -> CameraGradient {
        if comptime!(model == CameraModel::Pinhole) {
            pinhole_vjp(self, mean, sight, g, s)
        } else {
            distorted_vjp(self, mean, sight, g, model)
        }
    }
}
