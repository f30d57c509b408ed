//! Gradients of the colours.

use cubecl::ir::ElemType;
use cubecl::prelude::*;
use splat_core::{ClampGradient, ShColorSettings, ShColorTensors, sh_coefficient_count};

use super::{Own, ShColorInputs, Sight, is_seen, own, own_coefficient, sight, unclamped};
use crate::launch::{Buffer, CUBE_UNITS, CUBE_UNITS_USIZE, cube_count, per_element};
use crate::math::{Vec3, is_below_zero};
use crate::reduce::{sum_blocks, sum_units};
use crate::sh::{basis, direction_vjp, guarded_dot};

/// Gaussians summed by one unit of the centres' gradient.
const CENTER_ITEMS: usize = 4;
/// Gaussians summed by one workgroup of the centres' gradient.
const CENTER_BLOCK: usize = CUBE_UNITS_USIZE * CENTER_ITEMS;

/// The gradient of a channel before the clamp: zero below zero, unless it `recovers` and descent
/// would raise it.
#[cube]
fn passed_on_channel(color: f32, g: f32, #[comptime] recovers: bool) -> f32 {
    let mut stops = is_below_zero(color);
    if comptime!(recovers) {
        stops = stops && !is_below_zero(g);
    }
    select(stops, 0.0f32, g)
}

/// The gradient of a colour before the clamp.
#[cube]
fn passed_on(color: Vec3, g: Vec3, #[comptime] recovers: bool) -> Vec3 {
    Vec3::new(
        passed_on_channel(color.x, g.x, recovers),
        passed_on_channel(color.y, g.y, recovers),
        passed_on_channel(color.z, g.z, recovers),
    )
}

/// The gradient of the direction, from that of the colour before the clamp.
#[cube]
fn sight_vjp<R: Float>(
    rest: &[R],
    sight: Sight,
    g: Vec3,
    own: Own,
    #[comptime] degree: usize,
    #[comptime] ragged: bool,
) -> Vec3 {
    let mut weights = Array::<f32>::new(comptime!(sh_coefficient_count(degree)));
    // The function of degree 0 does not depend on the direction.
    weights[0] = 0.0f32;
    #[unroll]
    for k in 1..comptime!(sh_coefficient_count(degree)) {
        weights[k] = guarded_dot(g, own_coefficient::<R>(rest, own, k, ragged));
    }
    direction_vjp(sight.unit, sight.inverse, &weights, degree)
}

/// Gradients of Gaussians, summed over cameras; zero for coefficients that are not read.
#[cube(launch)]
fn sh_colors_backward_gaussians<R: Float>(
    sh0: &[f32],
    rest: &[R],
    means: &[f32],
    centers: &[f32],
    packed: &[f32],
    grad_colors: &[f32],
    starts: ComptimeOption<&[u32]>,
    grad_sh0: &mut [f32],
    grad_rest: &mut [f32],
    grad_means: &mut [f32],
    gaussians: u32,
    cameras: u32,
    stored: u32,
    #[comptime] degree: usize,
    #[comptime] needs_grad: ShColorTensors<bool>,
    #[comptime] asked: bool,
    #[comptime] recovers: bool,
    #[comptime] ragged: bool,
    #[define(R)] _stored_as: ElemType,
) {
    let gaussians = gaussians as usize;
    let gaussian = ABSOLUTE_POS;
    if gaussian < gaussians {
        let own = own(&starts, gaussian, stored as usize);
        let mut y = Array::<f32>::new(comptime!(sh_coefficient_count(degree)));
        let mut sums = Array::<f32>::new(comptime!(3 * sh_coefficient_count(degree)));
        #[unroll]
        for k in 0..comptime!(3 * sh_coefficient_count(degree)) {
            sums[k] = 0.0f32;
        }
        let mut mean_x = 0.0f32;
        let mut mean_y = 0.0f32;
        let mut mean_z = 0.0f32;
        for camera in 0..cameras as usize {
            let index = camera * gaussians + gaussian;
            let g = Vec3::load(grad_colors, index * 3);
            // Splats without a gradient are skipped: zero times NaN would be NaN.
            if g.max_abs() != 0.0f32 && is_seen(packed, index, asked) {
                let sight = sight(means, centers, gaussian, camera);
                basis(sight.unit, &mut y, degree);
                let color = unclamped::<R>(sh0, rest, &y, gaussian, own, degree, ragged);
                let g = passed_on(color, g, recovers);
                if comptime!(needs_grad.sh0 || needs_grad.sh_rest) {
                    #[unroll]
                    for k in 0..comptime!(sh_coefficient_count(degree)) {
                        sums[k * 3] += y[k] * g.x;
                        sums[k * 3 + 1] += y[k] * g.y;
                        sums[k * 3 + 2] += y[k] * g.z;
                    }
                }
                if comptime!(needs_grad.means) {
                    let grad = sight_vjp::<R>(rest, sight, g, own, degree, ragged);
                    mean_x += grad.x;
                    mean_y += grad.y;
                    mean_z += grad.z;
                }
            }
        }
        if comptime!(needs_grad.sh0) {
            Vec3::new(sums[0], sums[1], sums[2]).store(grad_sh0, gaussian * 3);
        }
        if comptime!(needs_grad.sh_rest) {
            #[unroll]
            for k in 3..comptime!(3 * sh_coefficient_count(degree)) {
                if comptime!(ragged) {
                    if k / 3 <= own.count {
                        grad_rest[own.from + k - 3] = sums[k];
                    }
                } else {
                    grad_rest[own.from + k - 3] = sums[k];
                }
            }
            for k in comptime!(3 * sh_coefficient_count(degree) - 3)..own.count * 3 {
                grad_rest[own.from + k] = 0.0f32;
            }
        }
        if comptime!(needs_grad.means) {
            Vec3::new(mean_x, mean_y, mean_z).store(grad_means, gaussian * 3);
        }
    }
}

/// Gradients of centres: `partials[camera, block]` = sum over the Gaussians of the block.
#[cube(launch)]
fn sh_colors_backward_centers<R: Float>(
    sh0: &[f32],
    rest: &[R],
    means: &[f32],
    centers: &[f32],
    packed: &[f32],
    grad_colors: &[f32],
    starts: ComptimeOption<&[u32]>,
    partials: &mut [f32],
    gaussians: u32,
    cameras: u32,
    blocks: u32,
    stored: u32,
    #[comptime] degree: usize,
    #[comptime] asked: bool,
    #[comptime] recovers: bool,
    #[comptime] ragged: bool,
    #[define(R)] _stored_as: ElemType,
) {
    let mut shared = Shared::new_slice(CUBE_UNITS_USIZE);
    let gaussians = gaussians as usize;
    let camera = CUBE_POS / blocks as usize;
    let block = CUBE_POS % blocks as usize;
    let mut x = 0.0f32;
    let mut y = 0.0f32;
    let mut z = 0.0f32;
    if camera < cameras as usize {
        for item in 0..CENTER_ITEMS {
            let gaussian = block * CENTER_BLOCK + item * CUBE_UNITS_USIZE + UNIT_POS as usize;
            if gaussian < gaussians {
                let index = camera * gaussians + gaussian;
                let g = Vec3::load(grad_colors, index * 3);
                // As above: a broken, unseen splat must not reach the camera.
                if g.max_abs() != 0.0f32 && is_seen(packed, index, asked) {
                    let own = own(&starts, gaussian, stored as usize);
                    let sight = sight(means, centers, gaussian, camera);
                    let mut values = Array::<f32>::new(comptime!(sh_coefficient_count(degree)));
                    basis(sight.unit, &mut values, degree);
                    let color = unclamped::<R>(sh0, rest, &values, gaussian, own, degree, ragged);
                    let g = passed_on(color, g, recovers);
                    let grad = sight_vjp::<R>(rest, sight, g, own, degree, ragged);
                    x -= grad.x;
                    y -= grad.y;
                    z -= grad.z;
                }
            }
        }
    }
    let x = sum_units(&mut shared, x, CUBE_UNITS_USIZE);
    let y = sum_units(&mut shared, y, CUBE_UNITS_USIZE);
    let z = sum_units(&mut shared, z, CUBE_UNITS_USIZE);
    if UNIT_POS == 0 && camera < cameras as usize {
        Vec3::new(x, y, z).store(partials, CUBE_POS * 3);
    }
}

/// Gradients of sh0 [N, 1, 3], `sh_rest` in its own shape, means [N, 3] and centres [C, 3], from
/// that of the colours [C, N, 3]; only those that `needs_grad` names.
pub fn sh_colors_backward(
    client: &Client,
    inputs: &ShColorInputs,
    grad_colors: &Buffer,
    settings: ShColorSettings,
    needs_grad: ShColorTensors<bool>,
) -> ShColorTensors<Option<Buffer>> {
    let (gaussians, cameras) = (inputs.gaussians(), inputs.cameras());
    let degree = inputs.degree(settings.degree);
    let recovers = settings.clamp_gradient == ClampGradient::Recovering;
    let ragged = inputs.starts().is_some();
    let rest_len = match &inputs.sh_rest {
        Some(rest) if ragged => rest.len(),
        _ => gaussians * inputs.stored * 3,
    };
    // A gradient that is not needed still needs a buffer to bind.
    let reserve = |needed, len| Buffer::empty(client, if needed { len } else { 1 });
    let sh0 = reserve(needs_grad.sh0, gaussians * 3);
    let sh_rest = reserve(needs_grad.sh_rest, rest_len);
    let means = reserve(needs_grad.means, gaussians * 3);
    if (needs_grad.sh0 || needs_grad.sh_rest || needs_grad.means)
        && let Some((count, dim)) = per_element(gaussians)
    {
        let (rest, stored_as) = inputs.rest();
        let (packed, asked) = inputs.seen();
        let starts = inputs.starts();
        sh_colors_backward_gaussians::launch(
            client,
            count,
            dim,
            inputs.sh0.arg(),
            rest,
            inputs.means.arg(),
            inputs.centers.arg(),
            packed,
            grad_colors.arg(),
            starts.into(),
            sh0.arg(),
            sh_rest.arg(),
            means.arg(),
            gaussians as u32,
            cameras as u32,
            inputs.stored as u32,
            degree,
            needs_grad,
            asked,
            recovers,
            ragged,
            stored_as,
        );
    }
    let centers = needs_grad.centers.then(|| {
        let blocks = gaussians.div_ceil(CENTER_BLOCK);
        let partials = Buffer::empty(client, cameras * blocks * 3);
        if !partials.is_empty() {
            let (rest, stored_as) = inputs.rest();
            let (packed, asked) = inputs.seen();
            let starts = inputs.starts();
            sh_colors_backward_centers::launch(
                client,
                cube_count(cameras * blocks),
                CubeDim::new_1d(CUBE_UNITS),
                inputs.sh0.arg(),
                rest,
                inputs.means.arg(),
                inputs.centers.arg(),
                packed,
                grad_colors.arg(),
                starts.into(),
                partials.arg(),
                gaussians as u32,
                cameras as u32,
                blocks as u32,
                inputs.stored as u32,
                degree,
                asked,
                recovers,
                ragged,
                stored_as,
            );
        }
        sum_blocks(client, &partials, [cameras, blocks, 3])
    });
    ShColorTensors {
        sh0: needs_grad.sh0.then_some(sh0),
        sh_rest: needs_grad.sh_rest.then_some(sh_rest),
        means: needs_grad.means.then_some(means),
        centers,
        seen: None,
    }
}
