//! One camera: its projection of a point, and the vector-Jacobian product of that. Another camera
//! model replaces this file.
//!
//! ```text
//! p = W mean + t = (x, y, z)                      mean2d = (fx x/z + cx, fy y/z + cy)
//! u = clamp(x/z), v = clamp(y/z)                  J = [fx/z, 0, -fx u/z; 0, fy/z, -fy v/z]
//! ```

use cubecl::prelude::*;

use super::Uniforms;
use crate::math::{Mat3, Vec3};

/// W, t and the intrinsics of one camera.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Camera {
    w: Mat3,
    t: Vec3,
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
}

/// A point in a camera, with the camera linearised there.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Sight {
    /// Position in camera space.
    pub p: Vec3,
    pub mean_x: f32,
    pub mean_y: f32,
    /// Clamped x/z and y/z, and whether they were inside the clamp.
    u: f32,
    v: f32,
    u_inside: bool,
    v_inside: bool,
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
}

/// The clamp of x/z (or y/z): the image plus a margin on each side, relative to the actual
/// principal point.
#[cube]
fn clamp_to_view(ratio: f32, focal: f32, centre: f32, size: f32, margin: f32) -> (f32, bool) {
    let low = -(centre + margin * size) / focal;
    let high = (size - centre + margin * size) / focal;
    (max(low, min(ratio, high)), ratio >= low && ratio <= high)
}

#[cube]
impl Camera {
    pub fn load(viewmats: &[f32], intrinsics: &[f32], index: usize) -> Camera {
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
        }
    }

    pub fn sight(self, mean: Vec3, s: Uniforms) -> Sight {
        let p = self.w.mul_vec(mean).add(self.t);
        let mean_x = self.fx * p.x / p.z + self.cx;
        let mean_y = self.fy * p.y / p.z + self.cy;

        let (u, u_inside) = clamp_to_view(p.x / p.z, self.fx, self.cx, s.width, s.clamp_margin);
        let (v, v_inside) = clamp_to_view(p.y / p.z, self.fy, self.cy, s.height, s.clamp_margin);

        // J W = [fx/z (W1 - u W3); fy/z (W2 - v W3)]
        let jw1 = self.w.r0.sub(self.w.r2.scale(u)).scale(self.fx / p.z);
        let jw2 = self.w.r1.sub(self.w.r2.scale(v)).scale(self.fy / p.z);
        Sight {
            p,
            mean_x,
            mean_y,
            u,
            v,
            u_inside,
            v_inside,
            jw1,
            jw2,
        }
    }

    /// Vector-Jacobian product of [`Camera::sight`] at `mean`.
    pub fn sight_vjp(self, mean: Vec3, sight: Sight, g: SightGradient) -> CameraGradient {
        let Sight { p, u, v, .. } = sight;
        // J W = [fx/z (W1 - u W3); fy/z (W2 - v W3)]
        let w = self.w;
        let j1 = self.fx / p.z;
        let j2 = self.fy / p.z;
        let g_j1 = g.jw1.dot(w.r0.sub(w.r2.scale(u)));
        let g_j2 = g.jw2.dot(w.r1.sub(w.r2.scale(v)));
        let g_u = -j1 * g.jw1.dot(w.r2);
        let g_v = -j2 * g.jw2.dot(w.r2);
        // Inside, u = x/z. Outside, u = constant/fx - cx/fx.
        let g_u_inside = select(sight.u_inside, g_u, 0.0f32);
        let g_v_inside = select(sight.v_inside, g_v, 0.0f32);
        let g_u_held = g_u - g_u_inside;
        let g_v_held = g_v - g_v_inside;

        // mean2d = (fx x/z + cx, fy y/z + cy)
        let g_ratio_x = g_u_inside + g.mean_x * self.fx;
        let g_ratio_y = g_v_inside + g.mean_y * self.fy;
        let along = g_ratio_x * (p.x / p.z) + g_ratio_y * (p.y / p.z) + g_j1 * j1 + g_j2 * j2;
        let g_p = Vec3::new(g_ratio_x / p.z, g_ratio_y / p.z, g.depth - along / p.z);
        CameraGradient {
            mean: w.transpose_mul_vec(g_p),
            w: Mat3 {
                r0: g.jw1.scale(j1).add(mean.scale(g_p.x)),
                r1: g.jw2.scale(j2).add(mean.scale(g_p.y)),
                r2: mean
                    .scale(g_p.z)
                    .sub(g.jw1.scale(j1 * u))
                    .sub(g.jw2.scale(j2 * v)),
            },
            t: g_p,
            fx: g.mean_x * (p.x / p.z) + g_j1 / p.z - g_u_held * u / self.fx,
            fy: g.mean_y * (p.y / p.z) + g_j2 / p.z - g_v_held * v / self.fy,
            cx: g.mean_x - g_u_held / self.fx,
            cy: g.mean_y - g_v_held / self.fy,
        }
    }
}
