//! What all lenses with distortion share: they bend the way to the normalised image plane, which
//! focal lengths and principal point then take to pixels.

use cubecl::prelude::*;
use splat_core::CameraModel;

use super::camera::{Camera, CameraGradient, Coefficients, Sight, SightGradient};
use super::fisheye::{fisheye_plane, fisheye_vjp};
use super::opencv::{opencv_plane, opencv_vjp};
use crate::math::{Mat3, Vec3};

/// A point on the normalised image plane, with the lens linearised there.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Plane {
    /// a' and b'.
    pub a: f32,
    pub b: f32,
    /// By which splats are culled and sorted.
    pub depth: f32,
    /// True in the lens's domain.
    pub inside: bool,
    /// Derivatives of a' and of b' by the position in camera space. For a perspective lens those at
    /// the clamped position.
    pub n1: Vec3,
    pub n2: Vec3,
}

/// Gradients of the fields of a [`Plane`].
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct PlaneGradient {
    pub a: f32,
    pub b: f32,
    pub depth: f32,
    pub n1: Vec3,
    pub n2: Vec3,
}

/// Gradients of a lens through one point, and of that point.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct LensGradient {
    pub p: Vec3,
    pub k: Coefficients,
}

#[cube]
fn plane(camera: Camera, p: Vec3, #[comptime] model: CameraModel) -> Plane {
    if comptime!(model == CameraModel::OpenCv) {
        opencv_plane(camera.lens, p)
    } else {
        fisheye_plane(camera.lens, p)
    }
}

#[cube]
fn plane_vjp(
    camera: Camera,
    p: Vec3,
    g: PlaneGradient,
    #[comptime] model: CameraModel,
) -> LensGradient {
    if comptime!(model == CameraModel::OpenCv) {
        opencv_vjp(camera.lens, p, g)
    } else {
        fisheye_vjp(camera.lens, p, g)
    }
}

#[cube]
pub(super) fn distorted_sight(camera: Camera, p: Vec3, #[comptime] model: CameraModel) -> Sight {
    let plane = plane(camera, p, model);
    Sight {
        p,
        mean_x: camera.fx * plane.a + camera.cx,
        mean_y: camera.fy * plane.b + camera.cy,
        depth: plane.depth,
        inside: plane.inside,
        jw1: camera.w.transpose_mul_vec(plane.n1).scale(camera.fx),
        jw2: camera.w.transpose_mul_vec(plane.n2).scale(camera.fy),
    }
}

/// Vector-Jacobian product of [`distorted_sight`], of the point at `mean`.
#[cube]
pub(super) fn distorted_vjp(
    camera: Camera,
    mean: Vec3,
    sight: Sight,
    g: SightGradient,
    #[comptime] model: CameraModel,
) -> CameraGradient {
    let plane = plane(camera, sight.p, model);
    let Camera { w, fx, fy, .. } = camera;
    // J W, with J = diag(fx, fy) N -> N, W, fx, fy.
    let g_n1 = w.mul_vec(g.jw1);
    let g_n2 = w.mul_vec(g.jw2);
    let g_plane = PlaneGradient {
        a: g.mean_x * fx,
        b: g.mean_y * fy,
        depth: g.depth,
        n1: g_n1.scale(fx),
        n2: g_n2.scale(fy),
    };
    let lens = plane_vjp(camera, sight.p, g_plane, model);
    let row1 = g.jw1.scale(fx);
    let row2 = g.jw2.scale(fy);
    CameraGradient {
        mean: w.transpose_mul_vec(lens.p),
        w: Mat3 {
            r0: mean
                .scale(lens.p.x)
                .add(row1.scale(plane.n1.x))
                .add(row2.scale(plane.n2.x)),
            r1: mean
                .scale(lens.p.y)
                .add(row1.scale(plane.n1.y))
                .add(row2.scale(plane.n2.y)),
            r2: mean
                .scale(lens.p.z)
                .add(row1.scale(plane.n1.z))
                .add(row2.scale(plane.n2.z)),
        },
        t: lens.p,
        fx: g.mean_x * plane.a + plane.n1.dot(g_n1),
        fy: g.mean_y * plane.b + plane.n2.dot(g_n2),
        cx: g.mean_x,
        cy: g.mean_y,
        k: lens.k,
    }
}
