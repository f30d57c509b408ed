//! What all lenses with distortion share: they bend the way to the normalised image plane, which
//! focal lengths and principal point then take to pixels.

use super::super::math::*;
use super::super::real::Real;
use super::camera::{COEFFICIENTS, Camera, Lens, LensGradient, Sight};
use crate::settings::ProjectArgs;

/// A point on the normalised image plane, with the lens linearised there.
#[derive(Clone, Copy)]
pub(super) struct Plane<T> {
    /// (a', b').
    pub(super) point: [T; 2],
    /// By which splats are culled and sorted.
    pub(super) depth: T,
    /// True in the lens's domain.
    pub(super) inside: bool,
    /// Derivatives of a' and b' by the position in camera space, 1 / world units. For a perspective
    /// lens those at the clamped position.
    pub(super) jacobian: Mat23<T>,
}

/// A lens that bends the way to the normalised image plane.
pub(super) trait Bend<T: Real>: Copy + Send + Sync {
    /// Number of coefficients.
    const COEFFICIENTS: usize;

    /// The lens from its coefficients and its domain.
    fn new(coefficients: &[T], domain: &[T]) -> Self;

    /// Where a point in camera space falls.
    fn plane(&self, p: Vec3<T>) -> Plane<T>;

    /// Gradients of the point in camera space and of the coefficients, from those of [`Plane`]'s
    /// point, depth and Jacobian.
    fn plane_backward(
        &self,
        p: Vec3<T>,
        dpoint: [T; 2],
        ddepth: T,
        djacobian: Mat23<T>,
    ) -> (Vec3<T>, [T; COEFFICIENTS]);
}

/// A lens with distortion.
#[derive(Clone, Copy)]
pub(super) struct Distorted<B>(B);

impl<T: Real, B: Bend<T>> Lens<T> for Distorted<B> {
    type Kept = Plane<T>;
    const COEFFICIENTS: usize = B::COEFFICIENTS;

    fn new(_: [T; 4], coefficients: &[T], domain: &[T], _: &ProjectArgs) -> Self {
        Self(B::new(coefficients, domain))
    }

    #[inline(always)]
    fn sight(camera: &Camera<T, Self>, p: Vec3<T>) -> Sight<T, Plane<T>> {
        let plane = camera.lens.0.plane(p);
        let [a, b] = plane.point;
        let [n1, n2] = plane.jacobian;
        Sight {
            p,
            mean: [camera.fx * a + camera.cx, camera.fy * b + camera.cy],
            depth: plane.depth,
            inside: plane.inside,
            jw: [
                scale(apply_transposed(&camera.w, n1), camera.fx),
                scale(apply_transposed(&camera.w, n2), camera.fy),
            ],
            kept: plane,
        }
    }

    #[inline(always)]
    fn sight_backward(
        camera: &Camera<T, Self>,
        s: &Sight<T, Plane<T>>,
        grad: [T; 3],
        djw: Mat23<T>,
    ) -> LensGradient<T> {
        let Camera { w, fx, fy, .. } = camera;
        let [n1, n2] = s.kept.jacobian;
        let [a, b] = s.kept.point;
        // J W, with J = diag(fx, fy) N -> N, W, fx, fy.
        let dn1 = apply(w, djw[0]);
        let dn2 = apply(w, djw[1]);
        let dw = add3(
            &outer(scale(n1, *fx), djw[0]),
            &outer(scale(n2, *fy), djw[1]),
        );
        let intrinsics = [
            grad[0] * a + dot(n1, dn1),
            grad[1] * b + dot(n2, dn2),
            grad[0],
            grad[1],
        ];
        let (p, coefficients) = camera.lens.0.plane_backward(
            s.p,
            [grad[0] * *fx, grad[1] * *fy],
            grad[2],
            [scale(dn1, *fx), scale(dn2, *fy)],
        );
        LensGradient {
            p,
            w: dw,
            intrinsics,
            coefficients,
        }
    }
}
