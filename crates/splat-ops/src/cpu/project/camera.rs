//! One camera: its projection of a point, and the gradient of that. What differs between camera
//! models is a [`Lens`].

use super::super::math::*;
use super::super::real::Real;
use crate::settings::ProjectArgs;

/// Most coefficients that a lens has.
pub(super) const COEFFICIENTS: usize = 8;

/// A point in a camera, with the camera linearised there.
#[derive(Clone, Copy)]
pub(super) struct Sight<T, K> {
    /// Position in camera space.
    pub(super) p: Vec3<T>,
    /// Position in the image, in pixels.
    pub(super) mean: [T; 2],
    /// By which splats are culled and sorted.
    pub(super) depth: T,
    /// True if the lens is defined there.
    pub(super) inside: bool,
    /// J W.
    pub(super) jw: Mat23<T>,
    /// What the gradient of the lens needs besides.
    pub(super) kept: K,
}

/// Gradients of a lens through one point, and of that point in camera space.
pub(super) struct LensGradient<T> {
    pub(super) p: Vec3<T>,
    /// Gradient of W through J W.
    pub(super) w: Mat3<T>,
    /// Gradients of fx, fy, cx, cy.
    pub(super) intrinsics: [T; 4],
    /// Gradients of the coefficients; zero beyond their number.
    pub(super) coefficients: [T; COEFFICIENTS],
}

/// A camera model: where a point in camera space falls in the image, linearised, and the gradient
/// of both. Branch-free, so that a loop over points becomes SIMD code.
pub(super) trait Lens<T: Real>: Copy + Send + Sync {
    /// What the forward pass keeps for the gradient.
    type Kept: Copy;
    /// Number of coefficients.
    const COEFFICIENTS: usize;

    /// The lens of one camera.
    fn new(intrinsics: [T; 4], coefficients: &[T], domain: &[T], args: &ProjectArgs) -> Self;

    /// The point `p` as the camera sees it.
    fn sight(camera: &Camera<T, Self>, p: Vec3<T>) -> Sight<T, Self::Kept>;

    /// Gradients, from those of screen mean, depth and J W.
    fn sight_backward(
        camera: &Camera<T, Self>,
        sight: &Sight<T, Self::Kept>,
        grad: [T; 3],
        djw: Mat23<T>,
    ) -> LensGradient<T>;
}

/// Gradients of a camera through one point, and of that point.
pub(super) struct CameraGradient<T> {
    pub(super) mean: Vec3<T>,
    /// Gradients of W and t.
    pub(super) w: Mat3<T>,
    pub(super) t: Vec3<T>,
    /// Gradients of fx, fy, cx, cy.
    pub(super) intrinsics: [T; 4],
    pub(super) coefficients: [T; COEFFICIENTS],
}

/// One camera, in the precision of the op.
pub(super) struct Camera<T, L> {
    /// World to camera, 3x3 block.
    pub(super) w: Mat3<T>,
    pub(super) t: Vec3<T>,
    pub(super) fx: T,
    pub(super) fy: T,
    pub(super) cx: T,
    pub(super) cy: T,
    pub(super) lens: L,
    pub(super) width: T,
    pub(super) height: T,
    pub(super) near: T,
    pub(super) far: T,
    /// Square root of `eps2d`.
    pub(super) blur: T,
    /// Distance in standard deviations at which alpha has fallen from 1 to `alpha_min`.
    pub(super) reach: T,
}

impl<T: Real, L: Lens<T>> Camera<T, L> {
    pub(super) fn new(
        viewmat: &[T],
        intrinsics: &[T],
        coefficients: &[T],
        domain: &[T],
        args: &ProjectArgs,
    ) -> Self {
        let row = |i: usize| [viewmat[4 * i], viewmat[4 * i + 1], viewmat[4 * i + 2]];
        let intrinsics = [0, 1, 2, 3].map(|i| intrinsics[i]);
        let [fx, fy, cx, cy] = intrinsics;
        Self {
            w: [row(0), row(1), row(2)],
            t: [viewmat[3], viewmat[7], viewmat[11]],
            fx,
            fy,
            cx,
            cy,
            lens: L::new(intrinsics, coefficients, domain, args),
            width: T::of(args.size.width.into()),
            height: T::of(args.size.height.into()),
            near: T::of(args.settings.near),
            far: T::of(args.settings.far),
            blur: T::of(args.settings.eps2d.sqrt()),
            reach: T::of((-2.0 * args.settings.alpha_min.ln()).max(0.0).sqrt()),
        }
    }

    #[inline(always)]
    pub(super) fn sight(&self, mean: Vec3<T>) -> Sight<T, L::Kept> {
        L::sight(self, add(apply(&self.w, mean), self.t))
    }

    /// Gradients, from those of screen mean, depth and J W of the point at `mean`.
    #[inline(always)]
    pub(super) fn sight_backward(
        &self,
        mean: Vec3<T>,
        s: &Sight<T, L::Kept>,
        grad: [T; 3],
        djw: Mat23<T>,
    ) -> CameraGradient<T> {
        let g = L::sight_backward(self, s, grad, djw);
        // p = W mean + t.
        CameraGradient {
            mean: apply_transposed(&self.w, g.p),
            w: add3(&g.w, &outer(g.p, mean)),
            t: g.p,
            intrinsics: g.intrinsics,
            coefficients: g.coefficients,
        }
    }
}
