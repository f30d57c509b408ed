//! Projection of 3D Gaussians to screen splats, and its vector-Jacobian product (3DGS section 4; gsplat appendix).
//!
//! Per camera and Gaussian, with W, t the view matrix, R the rotation of the normalised quaternion, s the scale:
//! ```text
//! p = W mean + t = (x, y, z)                      mean2d = (fx x/z + cx, fy y/z + cy)
//! u = clamp(x/z), v = clamp(y/z)                  J = [fx/z, 0, -fx u/z; 0, fy/z, -fy v/z]
//! V = J W R diag(s), rows V1, V2                  m = V1 x V2
//! a = |V1|² + e, b = V1·V2                        det = |m|² + e(|V1|² + |V2|²) + e²
//! w11 = 1/√a, w22 = √(a/det), w21 = -(b/a) w22    compensation = |m| / √det
//! ```
//! The determinant is a sum of terms that are never negative (Cauchy-Binet), so needles keep their precision. V and e
//! are taken in units of the splat's own size (k pixels), so that nothing over- or underflows, be the splat a millionth
//! of a pixel or a million pictures wide.
//! Floor per Gaussian and camera: 40 bytes read, 36 written, about 150 operations; gradients: 76 bytes read, 40 written,
//! and once more 76 read for those of cameras.
//!
//! One unit projects one Gaussian to one camera. Gradients of Gaussians are summed over cameras inside one unit;
//! gradients of cameras by blocks of Gaussians and then over the blocks, always in the same order: no atomics.

use cubecl::prelude::*;
use splat_core::{
    ImageSize, PROJECTED_DEPTH, PROJECTED_WIDTH, ProjectSettings, ProjectTensors, SPLAT_SIZE_MAX,
};

use crate::floor::{Bytes, Sizes};
use crate::launch::{Buffer, CUBE_UNITS, CUBE_UNITS_USIZE, cube_count, per_element};
use crate::math::{Mat3, Quat, Vec3, is_finite};

const SIZE_MAX: f32 = SPLAT_SIZE_MAX as f32;

/// Values of a camera's gradient: three rows [W | t], then fx, fy, cx, cy.
const CAMERA_VALUES: usize = 16;
/// Gaussians that one unit of the camera gradient sums.
const CAMERA_ITEMS: usize = 4;
/// Gaussians that one workgroup of the camera gradient sums.
const CAMERA_BLOCK: usize = CUBE_UNITS_USIZE * CAMERA_ITEMS;

/// Image size and [`ProjectSettings`] on the device; `blur` = √e; `reach` = √(2 ln(1/alpha_min)), standard deviations to
/// the edge of a splat.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Uniforms {
    width: f32,
    height: f32,
    near: f32,
    far: f32,
    blur: f32,
    clamp_margin: f32,
    reach: f32,
}

fn uniforms(size: ImageSize, settings: &ProjectSettings) -> UniformsLaunch {
    UniformsLaunch::new(
        size.width as f32,
        size.height as f32,
        settings.near as f32,
        settings.far as f32,
        (settings.eps2d as f32).sqrt(),
        settings.clamp_margin as f32,
        (-2.0 * (settings.alpha_min as f32).ln()).max(0.0).sqrt(),
    )
}

/// The inputs of the projection.
pub type ProjectInputs = ProjectTensors<Buffer>;

fn gaussians(inputs: &ProjectInputs) -> usize {
    (inputs.means.len() / 3)
        .min(inputs.quats.len() / 4)
        .min(inputs.scales.len() / 3)
}

fn cameras(inputs: &ProjectInputs) -> usize {
    (inputs.viewmats.len() / 16).min(inputs.intrinsics.len() / 4)
}

/// A Gaussian as stored.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Gaussian {
    mean: Vec3,
    quat: Quat,
    scale: Vec3,
}

#[cube]
impl Gaussian {
    fn load(means: &[f32], quats: &[f32], scales: &[f32], index: usize) -> Gaussian {
        Gaussian {
            mean: Vec3::load(means, index * 3),
            quat: Quat::load(quats, index * 4),
            scale: Vec3::load(scales, index * 3),
        }
    }
}

/// W, t and the intrinsics of one camera.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Camera {
    w: Mat3,
    t: Vec3,
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
}

#[cube]
impl Camera {
    fn load(viewmats: &[f32], intrinsics: &[f32], index: usize) -> Camera {
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
}

/// Everything that the projection of one Gaussian computes, named as in the formula.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Splat {
    /// Not culled. The other fields mean nothing if this is false.
    visible: bool,
    p: Vec3,
    mean_x: f32,
    mean_y: f32,
    /// Clamped x/z and y/z, and whether the clamp left them alone.
    u: f32,
    v: f32,
    u_free: bool,
    v_free: bool,
    /// Unit quaternion.
    q: Quat,
    r: Mat3,
    /// Rows of J W.
    jw1: Vec3,
    jw2: Vec3,
    /// Rows of J W R.
    jwr1: Vec3,
    jwr2: Vec3,
    /// Unit of length from here to `w22`, in pixels.
    k: f32,
    /// Larger than [`SIZE_MAX`]: its shape has no influence.
    flat: bool,
    v1: Vec3,
    v2: Vec3,
    /// Direction of the minors, not normalised, and its length.
    m: Vec3,
    m_norm: f32,
    /// Length of the minors.
    m_length: f32,
    e: f32,
    a: f32,
    b: f32,
    det: f32,
    w11: f32,
    w21: f32,
    w22: f32,
    compensation: f32,
    extent_x: f32,
    extent_y: f32,
}

/// The clamp of x/z (or y/z): the image plus a margin on each side, about the real principal point.
#[cube]
fn clamp_to_view(ratio: f32, focal: f32, centre: f32, size: f32, margin: f32) -> (f32, bool) {
    let low = -(centre + margin * size) / focal;
    let high = (size - centre + margin * size) / focal;
    (max(low, min(ratio, high)), ratio >= low && ratio <= high)
}

#[cube]
fn project_splat(g: Gaussian, camera: Camera, s: Uniforms) -> Splat {
    let p = camera.w.mul_vec(g.mean).add(camera.t);
    let mean_x = camera.fx * p.x / p.z + camera.cx;
    let mean_y = camera.fy * p.y / p.z + camera.cy;

    let (u, u_free) = clamp_to_view(p.x / p.z, camera.fx, camera.cx, s.width, s.clamp_margin);
    let (v, v_free) = clamp_to_view(p.y / p.z, camera.fy, camera.cy, s.height, s.clamp_margin);

    // J W = [fx/z (W1 - u W3); fy/z (W2 - v W3)]
    let jw1 = camera.w.r0.sub(camera.w.r2.scale(u)).scale(camera.fx / p.z);
    let jw2 = camera.w.r1.sub(camera.w.r2.scale(v)).scale(camera.fy / p.z);
    let q = g.quat.normalize();
    let r = q.to_matrix();
    let jwr1 = r.transpose_mul_vec(jw1);
    let jwr2 = r.transpose_mul_vec(jw2);

    // V over its largest entry, `size` pixels.
    let largest_scale = g.scale.max_abs();
    let relative = g.scale.over(largest_scale);
    let row1 = jwr1.mul(relative);
    let row2 = jwr2.mul(relative);
    let largest_entry = max(row1.max_abs(), row2.max_abs());
    let row1 = row1.over(largest_entry);
    let row2 = row2.over(largest_entry);
    let size = largest_entry * largest_scale;
    let flat = size > SIZE_MAX;
    let size = min(size, SIZE_MAX);

    let k = max(size, s.blur);
    let share = size / k;
    let blur = s.blur / k;
    let v1 = row1.scale(share);
    let v2 = row2.scale(share);
    let m = row1.cross(row2);
    let m_norm = f32::sqrt(m.dot(m));
    let m_length = share * share * m_norm;
    let v1_v1 = v1.dot(v1);
    let v2_v2 = v2.dot(v2);
    let e = blur * blur;
    let a = v1_v1 + e;
    let b = v1.dot(v2);
    let det = m_length * m_length + e * (v1_v1 + v2_v2) + e * e;

    let w11 = 1.0f32 / f32::sqrt(a);
    let w22 = f32::sqrt(a / det);
    let w21 = -(b / a) * w22;
    let compensation = m_length / f32::sqrt(det);
    let reach = s.reach * k;
    let extent_x = reach * f32::sqrt(a);
    let extent_y = reach * f32::sqrt(v2_v2 + e);

    // Written so that NaN fails; a non-finite input shows in one of these values.
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
    let in_depth = s.near <= p.z && p.z <= s.far;
    // Strict, as `splat_core` says of culling.
    let on_screen = mean_x + extent_x > 0.0f32
        && mean_x - extent_x < s.width
        && mean_y + extent_y > 0.0f32
        && mean_y - extent_y < s.height;

    Splat {
        visible: finite && in_depth && on_screen && g.quat.max_abs() > 0.0f32,
        p,
        mean_x,
        mean_y,
        u,
        v,
        u_free,
        v_free,
        q,
        r,
        jw1,
        jw2,
        jwr1,
        jwr2,
        k,
        flat,
        v1,
        v2,
        m,
        m_norm,
        m_length,
        e,
        a,
        b,
        det,
        w11,
        w21,
        w22,
        compensation,
        extent_x,
        extent_y,
    }
}

#[cube(launch)]
fn project_forward(
    means: &[f32],
    quats: &[f32],
    scales: &[f32],
    viewmats: &[f32],
    intrinsics: &[f32],
    packed: &mut [f32],
    gaussians: u32,
    cameras: u32,
    s: Uniforms,
) {
    let gaussians = gaussians as usize;
    let index = ABSOLUTE_POS;
    if index < gaussians * cameras as usize {
        let g = Gaussian::load(means, quats, scales, index % gaussians);
        let camera = Camera::load(viewmats, intrinsics, index / gaussians);
        let splat = project_splat(g, camera, s);
        let at = index * PROJECTED_WIDTH;
        if splat.visible {
            packed[at] = splat.mean_x;
            packed[at + 1] = splat.mean_y;
            packed[at + PROJECTED_DEPTH] = splat.p.z;
            packed[at + 3] = splat.w11 / splat.k;
            packed[at + 4] = splat.w21 / splat.k;
            packed[at + 5] = splat.w22 / splat.k;
            packed[at + 6] = splat.compensation;
            packed[at + 7] = splat.extent_x;
            packed[at + 8] = splat.extent_y;
        } else {
            for k in 0..PROJECTED_WIDTH {
                packed[at + k] = 0.0f32;
            }
        }
    }
}

/// What forward and gradient of the Gaussians must move for one camera.
pub(crate) fn floor(sizes: &Sizes) -> [Bytes; 2] {
    let n = sizes.gaussians;
    [
        Bytes {
            read: 40 * n,
            written: 36 * n,
        },
        Bytes {
            read: 76 * n,
            written: 40 * n,
        },
    ]
}

/// Projects every Gaussian to every camera: packed splats [C, N, 9], all zero where culled.
pub fn project(
    client: &Client,
    inputs: &ProjectInputs,
    size: ImageSize,
    settings: &ProjectSettings,
) -> Buffer {
    let (gaussians, cameras) = (gaussians(inputs), cameras(inputs));
    let packed = Buffer::empty(client, cameras * gaussians * PROJECTED_WIDTH);
    if let Some((count, dim)) = per_element(cameras * gaussians) {
        project_forward::launch(
            client,
            count,
            dim,
            inputs.means.arg(),
            inputs.quats.arg(),
            inputs.scales.arg(),
            inputs.viewmats.arg(),
            inputs.intrinsics.arg(),
            packed.arg(),
            gaussians as u32,
            cameras as u32,
            uniforms(size, settings),
        );
    }
    packed
}

/// Gradients of one projection to its Gaussian and its camera.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Gradient {
    mean: Vec3,
    quat: Quat,
    scale: Vec3,
    w: Mat3,
    t: Vec3,
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
}

/// Vector-Jacobian product of [`project_splat`] for the gradient at `grad_packed[at..at + 7]` (extents carry none).
#[cube]
fn project_vjp(
    g: Gaussian,
    camera: Camera,
    splat: Splat,
    grad_packed: &[f32],
    at: usize,
) -> Gradient {
    let g_mean_x = grad_packed[at];
    let g_mean_y = grad_packed[at + 1];
    let g_depth = grad_packed[at + 2];
    // Packed in 1 / pixels, here in 1 / k.
    let g_w11 = grad_packed[at + 3] / splat.k;
    let g_w21 = grad_packed[at + 4] / splat.k;
    let g_compensation = grad_packed[at + 6];
    let Splat {
        p,
        u,
        v,
        q,
        r,
        m,
        e,
        a,
        b,
        det,
        w22,
        v1,
        v2,
        ..
    } = splat;

    // w21 = -(b/a) w22,  w22 = √(a/det),  w11 = 1/√a,  compensation = |m|/√det
    let g_w22 = grad_packed[at + 5] / splat.k - g_w21 * (b / a);
    let g_b = -g_w21 * (w22 / a);
    let g_a = g_w21 * (b / a) * (w22 / a) + 0.5f32 * (g_w22 * w22 - g_w11 * splat.w11) / a;
    let g_det = -0.5f32 * (g_w22 * w22 + g_compensation * splat.compensation) / det;
    // det = |m|² + e(|V1|² + |V2|²) + e²;  the gradient of |m| at 0 is 0
    let g_length = 2.0f32 * g_det * splat.m_length + g_compensation / f32::sqrt(det);
    let g_m = m.scale(g_length).over(splat.m_norm);
    // V in units of k -> V in pixels
    let pixels = select(splat.flat, 0.0f32, 1.0f32 / splat.k);
    // m = V1 x V2,  a = |V1|² + e,  b = V1·V2
    let g_v1 = v2
        .cross(g_m)
        .add(v1.scale(2.0f32 * (e * g_det + g_a)))
        .add(v2.scale(g_b))
        .scale(pixels);
    let g_v2 = g_m
        .cross(v1)
        .add(v2.scale(2.0f32 * e * g_det))
        .add(v1.scale(g_b))
        .scale(pixels);

    // V = (J W R) diag(s)
    let g_scale = g_v1.mul(splat.jwr1).add(g_v2.mul(splat.jwr2));
    let g_jwr1 = g_v1.mul(g.scale);
    let g_jwr2 = g_v2.mul(g.scale);
    let g_r = Mat3 {
        r0: g_jwr1.scale(splat.jw1.x).add(g_jwr2.scale(splat.jw2.x)),
        r1: g_jwr1.scale(splat.jw1.y).add(g_jwr2.scale(splat.jw2.y)),
        r2: g_jwr1.scale(splat.jw1.z).add(g_jwr2.scale(splat.jw2.z)),
    };
    let g_quat = q.normalize_vjp(g.quat.length(), q.to_matrix_vjp(g_r));
    let g_jw1 = r.mul_vec(g_jwr1);
    let g_jw2 = r.mul_vec(g_jwr2);

    // J W = [fx/z (W1 - u W3); fy/z (W2 - v W3)]
    let w = camera.w;
    let j1 = camera.fx / p.z;
    let j2 = camera.fy / p.z;
    let g_j1 = g_jw1.dot(w.r0.sub(w.r2.scale(u)));
    let g_j2 = g_jw2.dot(w.r1.sub(w.r2.scale(v)));
    let g_u = -j1 * g_jw1.dot(w.r2);
    let g_v = -j2 * g_jw2.dot(w.r2);
    // Inside, u = x/z. Outside, u = constant/fx - cx/fx.
    let g_u_free = select(splat.u_free, g_u, 0.0f32);
    let g_v_free = select(splat.v_free, g_v, 0.0f32);
    let g_u_held = g_u - g_u_free;
    let g_v_held = g_v - g_v_free;

    // mean2d = (fx x/z + cx, fy y/z + cy)
    let g_ratio_x = g_u_free + g_mean_x * camera.fx;
    let g_ratio_y = g_v_free + g_mean_y * camera.fy;
    let g_p = Vec3::new(
        g_ratio_x / p.z,
        g_ratio_y / p.z,
        g_depth - (g_ratio_x * (p.x / p.z) + g_ratio_y * (p.y / p.z) + g_j1 * j1 + g_j2 * j2) / p.z,
    );

    Gradient {
        mean: w.transpose_mul_vec(g_p),
        quat: g_quat,
        scale: g_scale,
        w: Mat3 {
            r0: g_jw1.scale(j1).add(g.mean.scale(g_p.x)),
            r1: g_jw2.scale(j2).add(g.mean.scale(g_p.y)),
            r2: g
                .mean
                .scale(g_p.z)
                .sub(g_jw1.scale(j1 * u))
                .sub(g_jw2.scale(j2 * v)),
        },
        t: g_p,
        fx: g_mean_x * (p.x / p.z) + g_j1 / p.z - g_u_held * u / camera.fx,
        fy: g_mean_y * (p.y / p.z) + g_j2 / p.z - g_v_held * v / camera.fy,
        cx: g_mean_x - g_u_held / camera.fx,
        cy: g_mean_y - g_v_held / camera.fy,
    }
}

/// Gradients of Gaussians, summed over cameras.
#[cube(launch)]
fn project_backward_gaussians(
    means: &[f32],
    quats: &[f32],
    scales: &[f32],
    viewmats: &[f32],
    intrinsics: &[f32],
    grad_packed: &[f32],
    grad_means: &mut [f32],
    grad_quats: &mut [f32],
    grad_scales: &mut [f32],
    gaussians: u32,
    cameras: u32,
    s: Uniforms,
    #[comptime] needs_grad: ProjectTensors<bool>,
) {
    let gaussians = gaussians as usize;
    let index = ABSOLUTE_POS;
    if index < gaussians {
        let g = Gaussian::load(means, quats, scales, index);
        let mut mean_x = 0.0f32;
        let mut mean_y = 0.0f32;
        let mut mean_z = 0.0f32;
        let mut quat_w = 0.0f32;
        let mut quat_x = 0.0f32;
        let mut quat_y = 0.0f32;
        let mut quat_z = 0.0f32;
        let mut scale_x = 0.0f32;
        let mut scale_y = 0.0f32;
        let mut scale_z = 0.0f32;
        for c in 0..cameras as usize {
            let camera = Camera::load(viewmats, intrinsics, c);
            let splat = project_splat(g, camera, s);
            if splat.visible {
                let at = (c * gaussians + index) * PROJECTED_WIDTH;
                let grad = project_vjp(g, camera, splat, grad_packed, at);
                mean_x += grad.mean.x;
                mean_y += grad.mean.y;
                mean_z += grad.mean.z;
                quat_w += grad.quat.w;
                quat_x += grad.quat.x;
                quat_y += grad.quat.y;
                quat_z += grad.quat.z;
                scale_x += grad.scale.x;
                scale_y += grad.scale.y;
                scale_z += grad.scale.z;
            }
        }
        if comptime!(needs_grad.means) {
            Vec3::new(mean_x, mean_y, mean_z).store(grad_means, index * 3);
        }
        if comptime!(needs_grad.quats) {
            Quat::new(quat_w, quat_x, quat_y, quat_z).store(grad_quats, index * 4);
        }
        if comptime!(needs_grad.scales) {
            Vec3::new(scale_x, scale_y, scale_z).store(grad_scales, index * 3);
        }
    }
}

/// Gradients of cameras: `partials[c, block]` = sum over the Gaussians of the block.
#[cube(launch)]
fn project_backward_cameras(
    means: &[f32],
    quats: &[f32],
    scales: &[f32],
    viewmats: &[f32],
    intrinsics: &[f32],
    grad_packed: &[f32],
    partials: &mut [f32],
    gaussians: u32,
    cameras: u32,
    blocks: u32,
    s: Uniforms,
) {
    let mut shared = Shared::new_slice(CAMERA_VALUES * CUBE_UNITS_USIZE);
    let mut parts = Shared::new_slice(CUBE_UNITS_USIZE);
    let gaussians = gaussians as usize;
    let blocks = blocks as usize;
    let unit = UNIT_POS as usize;
    let c = CUBE_POS / blocks;
    let block = CUBE_POS % blocks;

    let mut sums = Array::<f32>::new(CAMERA_VALUES);
    #[unroll]
    for k in 0..CAMERA_VALUES {
        sums[k] = 0.0f32;
    }
    if c < cameras as usize {
        let camera = Camera::load(viewmats, intrinsics, c);
        for item in 0..CAMERA_ITEMS {
            let index = block * CAMERA_BLOCK + item * CUBE_UNITS_USIZE + unit;
            if index < gaussians {
                let g = Gaussian::load(means, quats, scales, index);
                let splat = project_splat(g, camera, s);
                if splat.visible {
                    let at = (c * gaussians + index) * PROJECTED_WIDTH;
                    let grad = project_vjp(g, camera, splat, grad_packed, at);
                    sums[0] += grad.w.r0.x;
                    sums[1] += grad.w.r0.y;
                    sums[2] += grad.w.r0.z;
                    sums[3] += grad.t.x;
                    sums[4] += grad.w.r1.x;
                    sums[5] += grad.w.r1.y;
                    sums[6] += grad.w.r1.z;
                    sums[7] += grad.t.y;
                    sums[8] += grad.w.r2.x;
                    sums[9] += grad.w.r2.y;
                    sums[10] += grad.w.r2.z;
                    sums[11] += grad.t.z;
                    sums[12] += grad.fx;
                    sums[13] += grad.fy;
                    sums[14] += grad.cx;
                    sums[15] += grad.cy;
                }
            }
        }
    }
    #[unroll]
    for k in 0..CAMERA_VALUES {
        shared[k * CUBE_UNITS_USIZE + unit] = sums[k];
    }
    sync_cube();
    // 256 units: 16 values, 16 parts of 16 units each; then 16 units add the parts.
    let mut part = 0.0f32;
    for k in 0..16usize {
        part += shared[unit * 16 + k];
    }
    parts[unit] = part;
    sync_cube();
    if unit < CAMERA_VALUES && c < cameras as usize {
        let mut sum = 0.0f32;
        for k in 0..16usize {
            sum += parts[unit * 16 + k];
        }
        partials[CUBE_POS * CAMERA_VALUES + unit] = sum;
    }
}

/// Adds the blocks' partial gradients of every camera, in order. The last row of a view matrix has no influence.
#[cube(launch)]
fn sum_camera_partials(
    partials: &[f32],
    grad_viewmats: &mut [f32],
    grad_intrinsics: &mut [f32],
    cameras: u32,
    blocks: u32,
    #[comptime] needs_grad: ProjectTensors<bool>,
) {
    let c = ABSOLUTE_POS / CAMERA_VALUES;
    let k = ABSOLUTE_POS % CAMERA_VALUES;
    if c < cameras as usize {
        let mut sum = 0.0f32;
        for block in 0..blocks as usize {
            sum += partials[(c * blocks as usize + block) * CAMERA_VALUES + k];
        }
        if k < 12 {
            if comptime!(needs_grad.viewmats) {
                grad_viewmats[c * 16 + k] = sum;
            }
        } else {
            if comptime!(needs_grad.viewmats) {
                grad_viewmats[c * 16 + k] = 0.0f32;
            }
            if comptime!(needs_grad.intrinsics) {
                grad_intrinsics[c * 4 + k - 12] = sum;
            }
        }
    }
}

/// Gradients of means [N, 3], quats [N, 4], scales [N, 3], viewmats [C, 4, 4] and intrinsics [C, 4] for the gradient
/// of the packed splats [C, N, 9]; only those that `needs_grad` names.
pub fn project_backward(
    client: &Client,
    inputs: &ProjectInputs,
    grad_packed: &Buffer,
    size: ImageSize,
    settings: &ProjectSettings,
    needs_grad: ProjectTensors<bool>,
) -> ProjectTensors<Option<Buffer>> {
    let (gaussians, cameras) = (gaussians(inputs), cameras(inputs));
    let lens = ProjectTensors {
        means: gaussians * 3,
        quats: gaussians * 4,
        scales: gaussians * 3,
        viewmats: cameras * 16,
        intrinsics: cameras * 4,
    };
    // A gradient that is not needed still needs something to bind.
    let grads = lens
        .zip(needs_grad)
        .map(|(len, needed)| Buffer::empty(client, if needed { len } else { 1 }));

    if (needs_grad.means || needs_grad.quats || needs_grad.scales)
        && let Some((count, dim)) = per_element(gaussians)
    {
        project_backward_gaussians::launch(
            client,
            count,
            dim,
            inputs.means.arg(),
            inputs.quats.arg(),
            inputs.scales.arg(),
            inputs.viewmats.arg(),
            inputs.intrinsics.arg(),
            grad_packed.arg(),
            grads.means.arg(),
            grads.quats.arg(),
            grads.scales.arg(),
            gaussians as u32,
            cameras as u32,
            uniforms(size, settings),
            needs_grad,
        );
    }
    if (needs_grad.viewmats || needs_grad.intrinsics) && cameras > 0 {
        let blocks = gaussians.div_ceil(CAMERA_BLOCK);
        let partials = Buffer::empty(client, cameras * blocks * CAMERA_VALUES);
        if blocks > 0 {
            project_backward_cameras::launch(
                client,
                cube_count(cameras * blocks),
                CubeDim::new_1d(CUBE_UNITS),
                inputs.means.arg(),
                inputs.quats.arg(),
                inputs.scales.arg(),
                inputs.viewmats.arg(),
                inputs.intrinsics.arg(),
                grad_packed.arg(),
                partials.arg(),
                gaussians as u32,
                cameras as u32,
                blocks as u32,
                uniforms(size, settings),
            );
        }
        if let Some((count, dim)) = per_element(cameras * CAMERA_VALUES) {
            sum_camera_partials::launch(
                client,
                count,
                dim,
                partials.arg(),
                grads.viewmats.arg(),
                grads.intrinsics.arg(),
                cameras as u32,
                blocks as u32,
                needs_grad,
            );
        }
    }
    grads
        .zip(needs_grad)
        .map(|(grad, needed)| needed.then_some(grad))
}
