//! The pinhole camera.
//!
//! ```text
//! p = W mean + t = (x, y, z)                      mean2d = (fx x/z + cx, fy y/z + cy)
//! u = clamp(x/z), v = clamp(y/z)                  J = [fx/z, 0, -fx u/z; 0, fy/z, -fy v/z]
//! ```

use cubecl::prelude::*;

use super::Uniforms;
use super::camera::{Camera, CameraGradient, Coefficients, Sight, SightGradient};
use crate::math::{Mat3, Vec3};

/// The clamp of x/z (or y/z): the image plus a margin on each side, relative to the actual
/// principal point.
#[cube]
fn clamp_to_view(ratio: f32, focal: f32, centre: f32, size: f32, margin: f32) -> (f32, bool) {
    let low = -(centre + margin * size) / focal;
    let high = (size - centre + margin * size) / focal;
    (max(low, min(ratio, high)), ratio >= low && ratio <= high)
}

#[cube]
pub(super) fn pinhole_sight(camera: Camera, p: Vec3, s: Uniforms) -> Sight {
    let Camera {
        w, fx, fy, cx, cy, ..
    } = camera;
    let (u, _) = clamp_to_view(p.x / p.z, fx, cx, s.width, s.clamp_margin);
    let (v, _) = clamp_to_view(p.y / p.z, fy, cy, s.height, s.clamp_margin);
    Sight {
        p,
        mean_x: fx * p.x / p.z + cx,
        mean_y: fy * p.y / p.z + cy,
        depth: p.z,
        inside: true.runtime(),
        // J W = [fx/z (W1 - u W3); fy/z (W2 - v W3)]
        jw1: w.r0.sub(w.r2.scale(u)).scale(fx / p.z),
        jw2: w.r1.sub(w.r2.scale(v)).scale(fy / p.z),
    }
}

#[cube]
pub(super) fn pinhole_vjp(
    camera: Camera,
    mean: Vec3,
    sight: Sight,
    g: SightGradient,
    s: Uniforms,
) -> CameraGradient {
    let Camera {
        w, fx, fy, cx, cy, ..
    } = camera;
    let p = sight.p;
    let (u, u_inside) = clamp_to_view(p.x / p.z, fx, cx, s.width, s.clamp_margin);
    let (v, v_inside) = clamp_to_view(p.y / p.z, fy, cy, s.height, s.clamp_margin);
    // J W = [fx/z (W1 - u W3); fy/z (W2 - v W3)]
    let j1 = fx / p.z;
    let j2 = fy / p.z;
    let g_j1 = g.jw1.dot(w.r0.sub(w.r2.scale(u)));
    let g_j2 = g.jw2.dot(w.r1.sub(w.r2.scale(v)));
    let g_u = -j1 * g.jw1.dot(w.r2);
    let g_v = -j2 * g.jw2.dot(w.r2);
    // Inside, u = x/z. Outside, u = constant/fx - cx/fx.
    let g_u_inside = select(u_inside, g_u, 0.0f32);
    let g_v_inside = select(v_inside, g_v, 0.0f32);
    let g_u_held = g_u - g_u_inside;
    let g_v_held = g_v - g_v_inside;

    // mean2d = (fx x/z + cx, fy y/z + cy)
    let g_ratio_x = g_u_inside + g.mean_x * fx;
    let g_ratio_y = g_v_inside + g.mean_y * fy;
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
        fx: g.mean_x * (p.x / p.z) + g_j1 / p.z - g_u_held * u / fx,
        fy: g.mean_y * (p.y / p.z) + g_j2 / p.z - g_v_held * v / fy,
        cx: g.mean_x - g_u_held / fx,
        cy: g.mean_y - g_v_held / fy,
        k: Coefficients::zero(),
    }
}
