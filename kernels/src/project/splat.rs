//! One Gaussian projected to one camera.

use cubecl::prelude::*;
use splat_core::{CameraModel, SPLAT_SIZE_MAX};

use super::Uniforms;
use super::camera::{Camera, Sight};
use crate::math::{Mat3, Quat, Vec3, is_finite};

const SIZE_MAX: f32 = SPLAT_SIZE_MAX as f32;

/// A Gaussian as stored.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Gaussian {
    pub mean: Vec3,
    pub quat: Quat,
    pub scale: Vec3,
}

#[cube]
impl Gaussian {
    pub fn load(means: &[f32], quats: &[f32], scales: &[f32], index: usize) -> Gaussian {
        Gaussian {
            mean: Vec3::load(means, index * 3),
            quat: Quat::load(quats, index * 4),
            scale: Vec3::load(scales, index * 3),
        }
    }
}

/// The 2D covariance with the low-pass filter, from V = J W R diag(s), in units of the splat's own
/// size.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Covariance {
    /// Unit of length, in pixels.
    pub k: f32,
    /// Larger than [`SPLAT_SIZE_MAX`]: its shape has no influence.
    pub flat: bool,
    pub v1: Vec3,
    pub v2: Vec3,
    /// Direction of the minors, unnormalised.
    pub m: Vec3,
    pub m_norm: f32,
    /// Length of the minors.
    pub m_length: f32,
    pub e: f32,
    pub a: f32,
    pub b: f32,
    /// Last diagonal entry, |V2|² + e.
    c: f32,
    pub det: f32,
}

/// Covariance of a Gaussian of this scale, from the rows of J W R; `blur` = √e in pixels.
#[cube]
fn covariance(jwr1: Vec3, jwr2: Vec3, scale: Vec3, blur: f32) -> Covariance {
    // V divided by its largest entry, `size` pixels.
    let largest_scale = scale.max_abs();
    let relative = scale.over(largest_scale);
    let row1 = jwr1.mul(relative);
    let row2 = jwr2.mul(relative);
    let largest_entry = max(row1.max_abs(), row2.max_abs());
    let row1 = row1.over(largest_entry);
    let row2 = row2.over(largest_entry);
    let size = largest_entry * largest_scale;
    let flat = size > SIZE_MAX;
    let size = min(size, SIZE_MAX);

    let k = max(size, blur);
    let share = size / k;
    let blur = blur / k;
    let v1 = row1.scale(share);
    let v2 = row2.scale(share);
    let m = row1.cross(row2);
    let m_norm = f32::sqrt(m.dot(m));
    let m_length = share * share * m_norm;
    let v1_v1 = v1.dot(v1);
    let v2_v2 = v2.dot(v2);
    let e = blur * blur;
    Covariance {
        k,
        flat,
        v1,
        v2,
        m,
        m_norm,
        m_length,
        e,
        a: v1_v1 + e,
        b: v1.dot(v2),
        c: v2_v2 + e,
        det: m_length * m_length + e * (v1_v1 + v2_v2) + e * e,
    }
}

/// All intermediate values of the projection of one Gaussian, named as in the formula.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Splat {
    /// True if not culled; otherwise the other fields are meaningless.
    pub visible: bool,
    pub sight: Sight,
    /// Unit quaternion.
    pub q: Quat,
    pub r: Mat3,
    /// Rows of J W R.
    pub jwr1: Vec3,
    pub jwr2: Vec3,
    pub covariance: Covariance,
    pub w11: f32,
    pub w21: f32,
    pub w22: f32,
    pub compensation: f32,
    pub extent_x: f32,
    pub extent_y: f32,
}

#[cube]
pub(super) fn project_splat(
    g: Gaussian,
    camera: Camera,
    s: Uniforms,
    #[comptime] model: CameraModel,
) -> Splat {
    let sight = camera.sight(g.mean, s, model);
    let q = g.quat.normalize();
    let r = q.to_matrix();
    let jwr1 = r.transpose_mul_vec(sight.jw1);
    let jwr2 = r.transpose_mul_vec(sight.jw2);
    let covariance = covariance(jwr1, jwr2, g.scale, s.blur);
    let Covariance {
        k, a, b, c, det, ..
    } = covariance;

    let w11 = 1.0f32 / f32::sqrt(a);
    let w22 = f32::sqrt(a / det);
    let w21 = -(b / a) * w22;
    let compensation = covariance.m_length / f32::sqrt(det);
    let reach = s.reach * k;
    let extent_x = reach * f32::sqrt(a);
    let extent_y = reach * f32::sqrt(c);

    // Written so that NaN fails; a non-finite input shows in one of these values.
    let Sight {
        p,
        mean_x,
        mean_y,
        depth,
        inside,
        ..
    } = sight;
    let finite = p.is_finite()
        && is_finite(mean_x)
        && is_finite(mean_y)
        && is_finite(w11)
        && is_finite(w21)
        && is_finite(w22)
        && is_finite(det)
        && is_finite(compensation)
        && is_finite(extent_x)
        && is_finite(extent_y);
    let in_depth = s.near <= depth && depth <= s.far;
    // Strict comparison, as `splat_core` defines culling.
    let on_screen = mean_x + extent_x > 0.0f32
        && mean_x - extent_x < s.width
        && mean_y + extent_y > 0.0f32
        && mean_y - extent_y < s.height;
    Splat {
        visible: finite && in_depth && inside && on_screen && g.quat.max_abs() > 0.0f32,
        sight,
        q,
        r,
        jwr1,
        jwr2,
        covariance,
        w11,
        w21,
        w22,
        compensation,
        extent_x,
        extent_y,
    }
}
