//! One Gaussian seen by one camera: the forward formulas. Branch-free, so that a loop over
//! Gaussians becomes SIMD code.

use splat_core::SPLAT_SIZE_MAX;

use super::super::math::*;
use super::super::real::Real;
use super::camera::{Camera, Lens, Sight};
use crate::backend::PROJECTED_WIDTH;

/// One Gaussian.
#[derive(Clone, Copy)]
pub(super) struct Gaussian<T> {
    pub(super) mean: Vec3<T>,
    pub(super) quat: [T; 4],
    pub(super) scale: Vec3<T>,
}

/// Intermediate values of the forward pass, recomputed in the backward pass.
pub(super) struct Splat<T, K> {
    /// True if not culled; if culled, all other fields are unspecified.
    pub(super) visible: bool,
    pub(super) sight: Sight<T, K>,
    pub(super) unit: [T; 4],
    pub(super) length: T,
    pub(super) rotation: Mat3<T>,
    /// J W R.
    pub(super) jwr: Mat23<T>,
    /// Unit of length of the fields below, except `packed`, in pixels.
    pub(super) k: T,
    /// Larger than [`SPLAT_SIZE_MAX`]: its shape has no influence.
    pub(super) flat: bool,
    pub(super) v1: Vec3<T>,
    pub(super) v2: Vec3<T>,
    /// Direction of the minors, unnormalised.
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

impl<T: Real, K: Copy> Splat<T, K> {
    /// Comparisons are written so that NaN culls.
    #[inline(always)]
    pub(super) fn new<L: Lens<T, Kept = K>>(g: Gaussian<T>, camera: &Camera<T, L>) -> Self {
        let sight = camera.sight(g.mean);
        let Sight { jw, depth, .. } = sight;
        let (unit, length, turns) = normalize_quat(g.quat);
        let rotation = rotation(unit);

        let jwr = [
            apply_transposed(&rotation, jw[0]),
            apply_transposed(&rotation, jw[1]),
        ];
        // V divided by its largest entry, `size` pixels.
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

        let mean = sight.mean;
        let reach = camera.reach * k;
        let extent = [reach * a.sqrt(), reach * (n2 + e).sqrt()];
        let w11 = T::ONE / a.sqrt();
        let w22 = (a / det).sqrt();
        let w21 = -(b / a) * w22;
        let packed = [
            mean[0],
            mean[1],
            depth,
            w11 / k,
            w21 / k,
            w22 / k,
            minors_length / det.sqrt(),
            extent[0],
            extent[1],
        ];
        // Strict comparison, as `splat_core` defines culling.
        let reaches = (mean[0] + extent[0] > T::ZERO)
            & (mean[0] - extent[0] < camera.width)
            & (mean[1] + extent[1] > T::ZERO)
            & (mean[1] - extent[1] < camera.height);
        let in_depth = (depth >= camera.near) & (depth <= camera.far);
        let mut visible = reaches & turns & in_depth & sight.inside;
        for value in packed {
            visible &= value.is_finite();
        }
        Self {
            visible,
            sight,
            unit,
            length,
            rotation,
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
