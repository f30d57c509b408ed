//! Spherical harmonics of a direction: colour per view, and the vector-Jacobian product (basis and
//! constants of 3DGS).
//!
//! ```text
//! colour = Σ_k Y_k(d / |d|) coefficient_k
//! ```
//! Real basis in homogeneous form, `(degree + 1)²` functions. The zero direction stays zero and
//! gets no gradient. Gradients of coefficients are summed over cameras inside one unit.
//!
//! Floor per Gaussian and camera, with K = `(degree + 1)²`: 12 bytes of direction and 12 K of
//! coefficients read, 12 written, about 9 K operations. Gradients: 24 bytes and 12 K read, 12 and
//! 12 K written, about 18 K operations.

use cubecl::prelude::*;
use splat_core::{SH_C0, SH_C1, SH_C2, SH_C3, SH_DEGREE_MAX, sh_coefficient_count};

use crate::launch::{Buffer, per_element};
use crate::math::Vec3;

const C0: f32 = SH_C0 as f32;
const C1: f32 = SH_C1 as f32;
const C2_XY: f32 = SH_C2[0] as f32;
const C2_ZZ: f32 = SH_C2[1] as f32;
const C2_XX: f32 = SH_C2[2] as f32;
const C3_XXX: f32 = SH_C3[0] as f32;
const C3_XYZ: f32 = SH_C3[1] as f32;
const C3_XZZ: f32 = SH_C3[2] as f32;
const C3_ZZZ: f32 = SH_C3[3] as f32;
const C3_ZXX: f32 = SH_C3[4] as f32;

/// `degree`, limited to [`SH_DEGREE_MAX`] and to the stored coefficients.
pub(crate) fn usable_degree(degree: usize, stored: usize) -> usize {
    let mut degree = degree.min(SH_DEGREE_MAX);
    while degree > 0 && sh_coefficient_count(degree) > stored {
        degree -= 1;
    }
    degree
}

/// `y[k]` = Y_k(d).
#[cube]
pub(crate) fn basis(d: Vec3, y: &mut Array<f32>, #[comptime] degree: usize) {
    y[0] = C0;
    if comptime!(degree >= 1) {
        y[1] = -C1 * d.y;
        y[2] = C1 * d.z;
        y[3] = -C1 * d.x;
    }
    if comptime!(degree >= 2) {
        let xx = d.x * d.x;
        let yy = d.y * d.y;
        let zz = d.z * d.z;
        y[4] = C2_XY * (d.x * d.y);
        y[5] = -C2_XY * (d.y * d.z);
        y[6] = C2_ZZ * (2.0f32 * zz - xx - yy);
        y[7] = -C2_XY * (d.x * d.z);
        y[8] = C2_XX * (xx - yy);
        if comptime!(degree >= 3) {
            y[9] = -C3_XXX * (d.y * (3.0f32 * xx - yy));
            y[10] = C3_XYZ * (d.x * d.y * d.z);
            y[11] = -C3_XZZ * (d.y * (4.0f32 * zz - xx - yy));
            y[12] = C3_ZZZ * (d.z * (2.0f32 * zz - 3.0f32 * xx - 3.0f32 * yy));
            y[13] = -C3_XZZ * (d.x * (4.0f32 * zz - xx - yy));
            y[14] = C3_ZXX * (d.z * (xx - yy));
            y[15] = -C3_XXX * (d.x * (xx - 3.0f32 * yy));
        }
    }
}

/// h = Σ_k g_k ∇Y_k(d), the gradients of [`basis`], term by term.
#[cube]
fn basis_vjp(d: Vec3, g: &Array<f32>, #[comptime] degree: usize) -> Vec3 {
    let Vec3 { x, y, z } = d;
    let mut gx = 0.0f32;
    let mut gy = 0.0f32;
    let mut gz = 0.0f32;
    if comptime!(degree >= 1) {
        gx -= C1 * g[3];
        gy -= C1 * g[1];
        gz += C1 * g[2];
    }
    if comptime!(degree >= 2) {
        let xx = x * x;
        let yy = y * y;
        let zz = z * z;
        gx += C2_XY * (y * g[4] - z * g[7]) + 2.0f32 * x * (C2_XX * g[8] - C2_ZZ * g[6]);
        gy += C2_XY * (x * g[4] - z * g[5]) - 2.0f32 * y * (C2_XX * g[8] + C2_ZZ * g[6]);
        gz += 4.0f32 * C2_ZZ * z * g[6] - C2_XY * (y * g[5] + x * g[7]);
        if comptime!(degree >= 3) {
            gx += C3_XYZ * y * z * g[10]
                - C3_XXX * (6.0f32 * x * y * g[9] + 3.0f32 * (xx - yy) * g[15])
                + C3_XZZ * (2.0f32 * x * y * g[11] - (4.0f32 * zz - 3.0f32 * xx - yy) * g[13])
                - 6.0f32 * C3_ZZZ * x * z * g[12]
                + 2.0f32 * C3_ZXX * x * z * g[14];
            gy += C3_XYZ * x * z * g[10]
                - C3_XXX * (3.0f32 * (xx - yy) * g[9] - 6.0f32 * x * y * g[15])
                + C3_XZZ * (2.0f32 * x * y * g[13] - (4.0f32 * zz - xx - 3.0f32 * yy) * g[11])
                - 6.0f32 * C3_ZZZ * y * z * g[12]
                - 2.0f32 * C3_ZXX * y * z * g[14];
            gz += C3_XYZ * x * y * g[10] - 8.0f32 * C3_XZZ * z * (y * g[11] + x * g[13])
                + C3_ZZZ * (6.0f32 * zz - 3.0f32 * xx - 3.0f32 * yy) * g[12]
                + C3_ZXX * (xx - yy) * g[14];
        }
    }
    Vec3::new(gx, gy, gz)
}

/// Gradient of d, from the gradients `g` of the functions of v = d/|d|: (h - v (v · h)) / |d|, with
/// h as in [`basis_vjp`].
#[cube]
pub(crate) fn direction_vjp(
    v: Vec3,
    inverse: f32,
    g: &Array<f32>,
    #[comptime] degree: usize,
) -> Vec3 {
    let h = basis_vjp(v, g, degree);
    h.sub(v.scale(v.dot(h))).scale(inverse)
}

/// `g · coefficient`, ignoring the coefficient, which may be infinite, of a channel without
/// gradient (black, and clamped there).
#[cube]
pub(crate) fn guarded_dot(g: Vec3, coefficient: Vec3) -> f32 {
    select(g.x == 0.0f32, 0.0f32, g.x * coefficient.x)
        + select(g.y == 0.0f32, 0.0f32, g.y * coefficient.y)
        + select(g.z == 0.0f32, 0.0f32, g.z * coefficient.z)
}

/// 1 / |d|, or 0 for the zero direction. Computed from d / max|dᵢ|, so that the squares neither
/// overflow nor underflow.
#[cube]
pub(crate) fn inverse_length(d: Vec3) -> f32 {
    let largest = d.max_abs();
    let mut inverse = 0.0f32;
    if largest > 0.0f32 {
        let scaled = Vec3::new(d.x / largest, d.y / largest, d.z / largest);
        inverse = 1.0f32 / f32::sqrt(scaled.dot(scaled)) / largest;
    }
    inverse
}

#[cube(launch)]
fn sh_forward(
    coefficients: &[f32],
    dirs: &[f32],
    colors: &mut [f32],
    gaussians: u32,
    cameras: u32,
    stored: u32,
    #[comptime] degree: usize,
) {
    let gaussians = gaussians as usize;
    let index = ABSOLUTE_POS;
    if index < gaussians * cameras as usize {
        let d = Vec3::load(dirs, index * 3);
        let mut y = Array::<f32>::new(comptime!(sh_coefficient_count(degree)));
        basis(d.scale(inverse_length(d)), &mut y, degree);
        let first = index % gaussians * stored as usize * 3;
        let mut red = 0.0f32;
        let mut green = 0.0f32;
        let mut blue = 0.0f32;
        #[unroll]
        for k in 0..comptime!(sh_coefficient_count(degree)) {
            red += y[k] * coefficients[first + k * 3];
            green += y[k] * coefficients[first + k * 3 + 1];
            blue += y[k] * coefficients[first + k * 3 + 2];
        }
        Vec3::new(red, green, blue).store(colors, index * 3);
    }
}

/// Colours [C, N, 3] from coefficients [N, `stored`, 3] and directions [C, N, 3] of any length.
/// Coefficients beyond `(degree + 1)²` are not read; `degree` is limited to [`SH_DEGREE_MAX`] and
/// to the stored coefficients.
pub fn evaluate(
    client: &Client,
    coefficients: &Buffer,
    dirs: &Buffer,
    stored: usize,
    degree: usize,
) -> Buffer {
    let (gaussians, cameras, degree) = sizes(coefficients, dirs, stored, degree);
    let colors = Buffer::empty(client, dirs.len());
    if let Some((count, dim)) = per_element(cameras * gaussians) {
        sh_forward::launch(
            client,
            count,
            dim,
            coefficients.arg(),
            dirs.arg(),
            colors.arg(),
            gaussians as u32,
            cameras as u32,
            stored as u32,
            degree,
        );
    }
    colors
}

fn sizes(
    coefficients: &Buffer,
    dirs: &Buffer,
    stored: usize,
    degree: usize,
) -> (usize, usize, usize) {
    let gaussians = coefficients.len() / (stored.max(1) * 3);
    let cameras = dirs.len() / 3 / gaussians.max(1);
    (gaussians, cameras, usable_degree(degree, stored))
}

/// Gradient of the coefficients: Σ over cameras of Y_k(d / |d|) g; 0 for those that are not read.
#[cube(launch)]
fn sh_backward_coefficients(
    dirs: &[f32],
    grad_colors: &[f32],
    grad_coefficients: &mut [f32],
    gaussians: u32,
    cameras: u32,
    stored: u32,
    #[comptime] degree: usize,
) {
    let gaussians = gaussians as usize;
    let index = ABSOLUTE_POS;
    if index < gaussians {
        let mut y = Array::<f32>::new(comptime!(sh_coefficient_count(degree)));
        let mut sums = Array::<f32>::new(comptime!(3 * sh_coefficient_count(degree)));
        #[unroll]
        for k in 0..comptime!(3 * sh_coefficient_count(degree)) {
            sums[k] = 0.0f32;
        }
        for c in 0..cameras as usize {
            let at = (c * gaussians + index) * 3;
            let d = Vec3::load(dirs, at);
            let g = Vec3::load(grad_colors, at);
            // Splats without a gradient are skipped: zero times NaN would be NaN.
            if g.max_abs() != 0.0f32 {
                basis(d.scale(inverse_length(d)), &mut y, degree);
                #[unroll]
                for k in 0..comptime!(sh_coefficient_count(degree)) {
                    sums[k * 3] += y[k] * g.x;
                    sums[k * 3 + 1] += y[k] * g.y;
                    sums[k * 3 + 2] += y[k] * g.z;
                }
            }
        }
        let first = index * stored as usize * 3;
        #[unroll]
        for k in 0..comptime!(3 * sh_coefficient_count(degree)) {
            grad_coefficients[first + k] = sums[k];
        }
        for k in comptime!(3 * sh_coefficient_count(degree))..stored as usize * 3 {
            grad_coefficients[first + k] = 0.0f32;
        }
    }
}

/// Gradient of the directions.
#[cube(launch)]
fn sh_backward_dirs(
    coefficients: &[f32],
    dirs: &[f32],
    grad_colors: &[f32],
    grad_dirs: &mut [f32],
    gaussians: u32,
    cameras: u32,
    stored: u32,
    #[comptime] degree: usize,
) {
    let gaussians = gaussians as usize;
    let index = ABSOLUTE_POS;
    if index < gaussians * cameras as usize {
        let d = Vec3::load(dirs, index * 3);
        let g = Vec3::load(grad_colors, index * 3);
        let inverse = inverse_length(d);
        let v = d.scale(inverse);
        let first = index % gaussians * stored as usize * 3;
        // Splats without a gradient are skipped: zero times NaN would be NaN, and reach the camera.
        if g.max_abs() != 0.0f32 {
            let mut weights = Array::<f32>::new(comptime!(sh_coefficient_count(degree)));
            #[unroll]
            for k in 0..comptime!(sh_coefficient_count(degree)) {
                weights[k] = guarded_dot(g, Vec3::load(coefficients, first + k * 3));
            }
            direction_vjp(v, inverse, &weights, degree).store(grad_dirs, index * 3);
        } else {
            Vec3::new(0.0f32, 0.0f32, 0.0f32).store(grad_dirs, index * 3);
        }
    }
}

/// Gradients of the coefficients [N, `stored`, 3] and directions [C, N, 3], from that of the
/// colours [C, N, 3]; only those that `needs_grad` names.
pub fn evaluate_backward(
    client: &Client,
    coefficients: &Buffer,
    dirs: &Buffer,
    grad_colors: &Buffer,
    stored: usize,
    degree: usize,
    needs_grad: [bool; 2],
) -> [Option<Buffer>; 2] {
    let (gaussians, cameras, degree) = sizes(coefficients, dirs, stored, degree);
    let grad_coefficients = needs_grad[0].then(|| {
        let grad = Buffer::empty(client, coefficients.len());
        if let Some((count, dim)) = per_element(gaussians) {
            sh_backward_coefficients::launch(
                client,
                count,
                dim,
                dirs.arg(),
                grad_colors.arg(),
                grad.arg(),
                gaussians as u32,
                cameras as u32,
                stored as u32,
                degree,
            );
        }
        grad
    });
    let grad_dirs = needs_grad[1].then(|| {
        let grad = Buffer::empty(client, dirs.len());
        if let Some((count, dim)) = per_element(cameras * gaussians) {
            sh_backward_dirs::launch(
                client,
                count,
                dim,
                coefficients.arg(),
                dirs.arg(),
                grad_colors.arg(),
                grad.arg(),
                gaussians as u32,
                cameras as u32,
                stored as u32,
                degree,
            );
        }
        grad
    });
    [grad_coefficients, grad_dirs]
}
