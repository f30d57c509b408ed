//! Noise of the means, shaped like each Gaussian (Kheradmand et al. 2024, section 3):
//!
//! ```text
//! mean += gate(o) R diag(s²) Rᵀ eps,   gate(o) = amount / (1 + exp(steepness (o - opacity)))
//! ```
//!
//! The draws eps are a hash of seed, step and row. One unit does one Gaussian, and means are
//! written where they are read if nothing else holds their memory.
//!
//! Floor per Gaussian: 44 bytes read and 12 written, about 150 operations.

use core::f32::consts::TAU;

use cubecl::prelude::*;
use splat_core::Perturbation;

use crate::launch::{Buffer, per_element};
use crate::math::{Quat, Vec3, is_finite};

const NEGLIGIBLE: f32 = splat_core::noise::NEGLIGIBLE_NOISE as f32;

#[derive(CubeType, CubeLaunch, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Noise {
    amount: f32,
    opacity: f32,
    steepness: f32,
    step: u32,
    seed_low: u32,
    seed_high: u32,
}

/// A number in (0, 1) from the upper 24 bits of a word.
#[cube]
fn uniform(word: u32) -> f32 {
    ((word >> 8u32) as f32 + 0.5f32) * 5.960_464_5e-8f32
}

/// `splat_core::noise::pcg4d` of (row, step, seed), and three standard normal draws of that.
#[cube]
fn draws(row: u32, noise: Noise) -> Vec3 {
    let mut x = row * 1664525u32 + 1013904223u32;
    let mut y = noise.step * 1664525u32 + 1013904223u32;
    let mut z = noise.seed_low * 1664525u32 + 1013904223u32;
    let mut w = noise.seed_high * 1664525u32 + 1013904223u32;
    x += y * w;
    y += z * x;
    z += x * y;
    w += y * z;
    x ^= x >> 16u32;
    y ^= y >> 16u32;
    z ^= z >> 16u32;
    w ^= w >> 16u32;
    x += y * w;
    y += z * x;
    z += x * y;
    w += y * z;
    let first = f32::sqrt(-2.0f32 * f32::ln(uniform(x)));
    let second = f32::sqrt(-2.0f32 * f32::ln(uniform(z)));
    let angle = TAU * uniform(y);
    let other = TAU * uniform(w);
    Vec3::new(
        first * f32::cos(angle),
        first * f32::sin(angle),
        second * f32::cos(other),
    )
}

#[cube(launch)]
fn perturb_rows(
    means: &[f32],
    quats: &[f32],
    log_scales: &[f32],
    opacity_logits: &[f32],
    out: &mut [f32],
    noise: Noise,
    gaussians: u32,
) {
    let row = ABSOLUTE_POS;
    if row < gaussians as usize {
        let mean = Vec3::load(means, row * 3);
        let opacity = 1.0f32 / (1.0f32 + f32::exp(-opacity_logits[row]));
        let gate = noise.amount / (1.0f32 + f32::exp(noise.steepness * (opacity - noise.opacity)));
        let scales = Vec3::new(
            f32::exp(log_scales[row * 3]),
            f32::exp(log_scales[row * 3 + 1]),
            f32::exp(log_scales[row * 3 + 2]),
        );
        let largest = max(scales.x, max(scales.y, scales.z));
        let quat = Quat::load(quats, row * 4);
        let (mut x, mut y, mut z) = (mean.x, mean.y, mean.z);
        if gate * largest > NEGLIGIBLE && quat.max_abs() > 0.0f32 {
            let axes = quat.normalize().to_matrix();
            let along = axes.transpose_mul_vec(draws(row as u32, noise));
            let along = along.mul(scales).scale(gate).mul(scales);
            let offset = axes.mul_vec(along);
            if is_finite(offset.x) && is_finite(offset.y) && is_finite(offset.z) {
                x += offset.x;
                y += offset.y;
                z += offset.z;
            }
        }
        Vec3::new(x, y, z).store(out, row * 3);
    }
}

/// Means `[N, 3]` after the noise, given quaternions `[N, 4]`, logarithms of the scales `[N, 3]`
/// and logits of the opacities `[N]`.
pub fn perturb(
    client: &Client,
    means: Buffer,
    quats: &Buffer,
    log_scales: &Buffer,
    opacity_logits: &Buffer,
    noise: &Perturbation,
) -> Buffer {
    let gaussians = opacity_logits.len();
    let (means, [means_in, means_out]) = means.overwritten(client, 0);
    if let Some((count, dim)) = per_element(gaussians) {
        perturb_rows::launch(
            client,
            count,
            dim,
            means_in,
            quats.arg(),
            log_scales.arg(),
            opacity_logits.arg(),
            means_out,
            NoiseLaunch::new(
                noise.amount as f32,
                noise.opacity as f32,
                noise.steepness as f32,
                noise.step,
                noise.seed as u32,
                (noise.seed >> 32) as u32,
            ),
            gaussians as u32,
        );
    }
    means
}
