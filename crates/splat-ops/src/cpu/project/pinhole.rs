//! The pinhole camera: two entries of its Jacobian are zero, and one clamp per axis keeps the rest
//! near the image.

use super::super::math::*;
use super::super::real::Real;
use super::camera::{COEFFICIENTS, Camera, Lens, LensGradient, Sight};
use crate::settings::ProjectArgs;

/// Bounds of x/z and y/z in the Jacobian.
#[derive(Clone, Copy)]
pub(super) struct Pinhole<T> {
    u: (T, T),
    v: (T, T),
}

/// x/z and y/z, clamped; and whether they were inside the clamp.
#[derive(Clone, Copy)]
pub(super) struct Clamped<T> {
    u: T,
    v: T,
    u_inside: bool,
    v_inside: bool,
}

impl<T: Real> Lens<T> for Pinhole<T> {
    type Kept = Clamped<T>;
    const COEFFICIENTS: usize = 0;

    fn new([fx, fy, cx, cy]: [T; 4], _: &[T], _: &[T], args: &ProjectArgs) -> Self {
        let margin = T::of(args.settings.clamp_margin);
        let bounds = |f: T, c: T, side: u32| {
            let side = T::of(side.into());
            (-(c + margin * side) / f, (side - c + margin * side) / f)
        };
        Self {
            u: bounds(fx, cx, args.size.width),
            v: bounds(fy, cy, args.size.height),
        }
    }

    #[inline(always)]
    fn sight(camera: &Camera<T, Self>, p: Vec3<T>) -> Sight<T, Clamped<T>> {
        let (lens, w) = (&camera.lens, &camera.w);
        let [x, y, z] = p;
        let (x_z, y_z) = (x / z, y / z);
        let u = x_z.greatest(lens.u.0).least(lens.u.1);
        let v = y_z.greatest(lens.v.0).least(lens.v.1);
        let jw: Mat23<T> = [
            add(scale(w[0], camera.fx / z), scale(w[2], -camera.fx * u / z)),
            add(scale(w[1], camera.fy / z), scale(w[2], -camera.fy * v / z)),
        ];
        Sight {
            p,
            mean: [camera.fx * x_z + camera.cx, camera.fy * y_z + camera.cy],
            depth: z,
            inside: true,
            jw,
            kept: Clamped {
                u,
                v,
                u_inside: (x_z >= lens.u.0) & (x_z <= lens.u.1),
                v_inside: (y_z >= lens.v.0) & (y_z <= lens.v.1),
            },
        }
    }

    #[inline(always)]
    fn sight_backward(
        camera: &Camera<T, Self>,
        s: &Sight<T, Clamped<T>>,
        grad: [T; 3],
        djw: Mat23<T>,
    ) -> LensGradient<T> {
        // J W -> J, W.
        let w = &camera.w;
        let [_, _, z] = s.p;
        let Clamped { u, v, .. } = s.kept;
        let (fx, fy) = (camera.fx, camera.fy);
        let dj11 = dot(djw[0], w[0]);
        let dj13 = dot(djw[0], w[2]);
        let dj22 = dot(djw[1], w[1]);
        let dj23 = dot(djw[1], w[2]);
        let dw = [
            scale(djw[0], fx / z),
            scale(djw[1], fy / z),
            add(scale(djw[0], -fx * u / z), scale(djw[1], -fy * v / z)),
        ];

        // J -> fx, fy, u, v, z.
        let mut dfx = (dj11 - dj13 * u) / z;
        let mut dfy = (dj22 - dj23 * v) / z;
        let (mut dcx, mut dcy) = (grad[0], grad[1]);
        let du = -dj13 * fx / z;
        let dv = -dj23 * fy / z;
        let mut dz = grad[2] - (fx * (dj11 - dj13 * u) + fy * (dj22 - dj23 * v)) / (z * z);

        // Screen mean (not clamped) -> x/z, y/z.
        let (x_z, y_z) = (s.p[0] / z, s.p[1] / z);
        dfx += grad[0] * x_z;
        dfy += grad[1] * y_z;
        let (mut dx_z, mut dy_z) = (grad[0] * fx, grad[1] * fy);

        // Inside the clamp the gradient passes; outside, u = const / fx - cx / fx depends on the
        // camera only.
        if s.kept.u_inside {
            dx_z += du;
        } else {
            dcx -= du / fx;
            dfx -= du * u / fx;
        }
        if s.kept.v_inside {
            dy_z += dv;
        } else {
            dcy -= dv / fy;
            dfy -= dv * v / fy;
        }
        dz -= (dx_z * x_z + dy_z * y_z) / z;
        LensGradient {
            p: [dx_z / z, dy_z / z, dz],
            w: dw,
            intrinsics: [dfx, dfy, dcx, dcy],
            coefficients: [T::ZERO; COEFFICIENTS],
        }
    }
}
