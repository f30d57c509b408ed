//! One camera: its projection of a point, and the gradient of that. Another camera model replaces
//! this file.

use super::super::math::*;
use super::super::real::Real;
use crate::settings::ProjectArgs;

/// A point in a camera, with the camera linearised there.
pub(super) struct Sight<T> {
    /// Position in camera space.
    pub(super) p: Vec3<T>,
    pub(super) mean: [T; 2],
    /// x/z and y/z, clamped; and whether they were inside the clamp.
    u: T,
    v: T,
    u_inside: bool,
    v_inside: bool,
    /// J W.
    pub(super) jw: Mat23<T>,
}

/// Gradients of a camera through one point, and of that point.
pub(super) struct CameraGradient<T> {
    pub(super) mean: Vec3<T>,
    /// Gradients of W and t.
    pub(super) w: Mat3<T>,
    pub(super) t: Vec3<T>,
    /// Gradients of fx, fy, cx, cy.
    pub(super) intrinsics: [T; 4],
}

/// One camera, in the precision of the op.
pub(super) struct Camera<T> {
    /// World to camera, 3x3 block.
    w: Mat3<T>,
    t: Vec3<T>,
    fx: T,
    fy: T,
    cx: T,
    cy: T,
    /// Bounds of u and v in the Jacobian.
    u: (T, T),
    v: (T, T),
    pub(super) width: T,
    pub(super) height: T,
    pub(super) near: T,
    pub(super) far: T,
    /// Square root of `eps2d`.
    pub(super) blur: T,
    /// Distance in standard deviations at which alpha has fallen from 1 to `alpha_min`.
    pub(super) reach: T,
}

impl<T: Real> Camera<T> {
    pub(super) fn new(viewmat: &[T], intrinsics: &[T], args: &ProjectArgs) -> Self {
        let row = |i: usize| [viewmat[4 * i], viewmat[4 * i + 1], viewmat[4 * i + 2]];
        let [fx, fy, cx, cy] = [0, 1, 2, 3].map(|i| intrinsics[i]);
        let (width, height) = (
            T::of(args.size.width.into()),
            T::of(args.size.height.into()),
        );
        let margin = T::of(args.settings.clamp_margin);
        let bounds =
            |f: T, c: T, side: T| (-(c + margin * side) / f, (side - c + margin * side) / f);
        Self {
            w: [row(0), row(1), row(2)],
            t: [viewmat[3], viewmat[7], viewmat[11]],
            fx,
            fy,
            cx,
            cy,
            u: bounds(fx, cx, width),
            v: bounds(fy, cy, height),
            width,
            height,
            near: T::of(args.settings.near),
            far: T::of(args.settings.far),
            blur: T::of(args.settings.eps2d.sqrt()),
            reach: T::of((-2.0 * args.settings.alpha_min.ln()).max(0.0).sqrt()),
        }
    }

    #[inline(always)]
    pub(super) fn sight(&self, mean: Vec3<T>) -> Sight<T> {
        let p = add(apply(&self.w, mean), self.t);
        let [x, y, z] = p;
        let (x_z, y_z) = (x / z, y / z);
        let u = x_z.greatest(self.u.0).least(self.u.1);
        let v = y_z.greatest(self.v.0).least(self.v.1);
        let jw: Mat23<T> = [
            add(
                scale(self.w[0], self.fx / z),
                scale(self.w[2], -self.fx * u / z),
            ),
            add(
                scale(self.w[1], self.fy / z),
                scale(self.w[2], -self.fy * v / z),
            ),
        ];
        Sight {
            p,
            mean: [self.fx * x_z + self.cx, self.fy * y_z + self.cy],
            u,
            v,
            u_inside: (x_z >= self.u.0) & (x_z <= self.u.1),
            v_inside: (y_z >= self.v.0) & (y_z <= self.v.1),
            jw,
        }
    }

    /// Gradients, from those of screen mean, depth and J W of the point at `mean`.
    #[inline(always)]
    pub(super) fn sight_backward(
        &self,
        mean: Vec3<T>,
        s: &Sight<T>,
        grad: [T; 3],
        djw: Mat23<T>,
    ) -> CameraGradient<T> {
        // J W -> J, W.
        let [_, _, z] = s.p;
        let (fx, fy) = (self.fx, self.fy);
        let dj11 = dot(djw[0], self.w[0]);
        let dj13 = dot(djw[0], self.w[2]);
        let dj22 = dot(djw[1], self.w[1]);
        let dj23 = dot(djw[1], self.w[2]);
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

        // Inside the clamp the gradient passes; outside, u = const / fx - cx / fx depends on the
        // camera only.
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
        dw = add3(&dw, &outer(dp, mean));
        CameraGradient {
            mean: apply_transposed(&self.w, dp),
            w: dw,
            t: dp,
            intrinsics: [dfx, dfy, dcx, dcy],
        }
    }
}
