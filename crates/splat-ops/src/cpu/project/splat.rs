//! One Gaussian seen by one camera: the forward formulas, without a branch, so that a loop over Gaussians becomes SIMD
//! code.

use splat_core::SPLAT_SIZE_MAX;

use super::super::math::*;
use super::super::real::Real;
use crate::backend::PROJECTED_WIDTH;
use crate::settings::ProjectArgs;

/// One camera, in the precision of the op.
pub(super) struct Camera<T> {
    /// World to camera, 3x3 block.
    pub(super) w: Mat3<T>,
    t: Vec3<T>,
    pub(super) fx: T,
    pub(super) fy: T,
    cx: T,
    cy: T,
    /// Bounds of u and v for the Jacobian.
    u: (T, T),
    v: (T, T),
    width: T,
    height: T,
    near: T,
    far: T,
    /// Square root of `eps2d`.
    blur: T,
    /// Standard deviations to where alpha has fallen from 1 to `alpha_min`.
    reach: T,
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
}

/// One Gaussian.
#[derive(Clone, Copy)]
pub(super) struct Gaussian<T> {
    pub(super) mean: Vec3<T>,
    pub(super) quat: [T; 4],
    pub(super) scale: Vec3<T>,
}

/// What the forward computes on its way; the backward computes it again.
pub(super) struct Splat<T> {
    /// Whether it is not culled. Where it is, all other fields may hold anything.
    pub(super) visible: bool,
    pub(super) p: Vec3<T>,
    /// x/z and y/z, clamped.
    pub(super) u: T,
    pub(super) v: T,
    pub(super) u_inside: bool,
    pub(super) v_inside: bool,
    pub(super) unit: [T; 4],
    pub(super) length: T,
    pub(super) rotation: Mat3<T>,
    /// J W.
    pub(super) jw: Mat23<T>,
    /// J W R.
    pub(super) jwr: Mat23<T>,
    /// Unit of length of everything below but `packed`, in pixels.
    pub(super) k: T,
    /// Larger than [`SPLAT_SIZE_MAX`]: its shape has no influence.
    pub(super) flat: bool,
    pub(super) v1: Vec3<T>,
    pub(super) v2: Vec3<T>,
    /// Direction of the minors, not normalised, and its length.
    pub(super) minors: Vec3<T>,
    pub(super) minors_norm: T,
    /// Length of the minors.
    pub(super) minors_length: T,
    pub(super) e: T,
    pub(super) a: T,
    pub(super) b: T,
    pub(super) det: T,
    pub(super) w11: T,
    pub(super) w21: T,
    pub(super) w22: T,
    pub(super) packed: [T; PROJECTED_WIDTH],
}

impl<T: Real> Splat<T> {
    /// Comparisons are written so that NaN culls.
    #[inline(always)]
    pub(super) fn new(g: Gaussian<T>, camera: &Camera<T>) -> Self {
        let p = add(apply(&camera.w, g.mean), camera.t);
        let [x, y, z] = p;
        let (unit, length, turns) = normalize_quat(g.quat);
        let rotation = rotation(unit);

        let (u_free, v_free) = (x / z, y / z);
        let u = u_free.greatest(camera.u.0).least(camera.u.1);
        let v = v_free.greatest(camera.v.0).least(camera.v.1);
        let jw: Mat23<T> = [
            add(
                scale(camera.w[0], camera.fx / z),
                scale(camera.w[2], -camera.fx * u / z),
            ),
            add(
                scale(camera.w[1], camera.fy / z),
                scale(camera.w[2], -camera.fy * v / z),
            ),
        ];
        let jwr = [
            apply_transposed(&rotation, jw[0]),
            apply_transposed(&rotation, jw[1]),
        ];
        // V over its largest entry, `size` pixels.
        let largest_scale = largest(g.scale);
        let shape = over(g.scale, largest_scale);
        let rows = [hadamard(jwr[0], shape), hadamard(jwr[1], shape)];
        let largest_entry = largest(rows[0]).greatest(largest(rows[1]));
        let rows = [over(rows[0], largest_entry), over(rows[1], largest_entry)];
        let size = largest_entry * largest_scale;
        let flat = size > T::of(SPLAT_SIZE_MAX);
        let size = size.least(T::of(SPLAT_SIZE_MAX));

        let k = size.greatest(camera.blur);
        let (share, blur) = (size / k, camera.blur / k);
        let (v1, v2) = (scale(rows[0], share), scale(rows[1], share));
        let minors = cross(rows[0], rows[1]);
        let minors_norm = dot(minors, minors).sqrt();
        let minors_length = share * share * minors_norm;
        let (n1, n2) = (dot(v1, v1), dot(v2, v2));
        let e = blur * blur;
        let (a, b) = (n1 + e, dot(v1, v2));
        let det = minors_length * minors_length + e * (n1 + n2) + e * e;

        let mean = [
            camera.fx * u_free + camera.cx,
            camera.fy * v_free + camera.cy,
        ];
        let reach = camera.reach * k;
        let extent = [reach * a.sqrt(), reach * (n2 + e).sqrt()];
        let w11 = T::ONE / a.sqrt();
        let w22 = (a / det).sqrt();
        let w21 = -(b / a) * w22;
        let packed = [
            mean[0],
            mean[1],
            z,
            w11 / k,
            w21 / k,
            w22 / k,
            minors_length / det.sqrt(),
            extent[0],
            extent[1],
        ];
        // Strict, as `splat_core` says of culling.
        let reaches = (mean[0] + extent[0] > T::ZERO)
            & (mean[0] - extent[0] < camera.width)
            & (mean[1] + extent[1] > T::ZERO)
            & (mean[1] - extent[1] < camera.height);
        let mut visible = reaches & turns & (z >= camera.near) & (z <= camera.far);
        for value in packed {
            visible &= value.is_finite();
        }
        Self {
            visible,
            p,
            u,
            v,
            u_inside: (u_free >= camera.u.0) & (u_free <= camera.u.1),
            v_inside: (v_free >= camera.v.0) & (v_free <= camera.v.1),
            unit,
            length,
            rotation,
            jw,
            jwr,
            k,
            flat,
            v1,
            v2,
            minors,
            minors_norm,
            minors_length,
            e,
            a,
            b,
            det,
            w11,
            w21,
            w22,
            packed,
        }
    }
}
