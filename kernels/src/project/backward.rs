//! Gradients of all Gaussians and cameras.

use cubecl::prelude::*;
use splat_core::{ImageSize, PROJECTED_WIDTH, ProjectSettings, ProjectTensors};

use super::camera::Camera;
use super::splat::{Gaussian, project_splat};
use super::vjp::project_vjp;
use super::{ProjectInputs, Uniforms, cameras, gaussians, uniforms};
use crate::launch::{Buffer, CUBE_UNITS, CUBE_UNITS_USIZE, cube_count, per_element};
use crate::math::{Quat, Vec3};

/// Values of a camera's gradient: three rows [W | t], then fx, fy, cx, cy.
const CAMERA_VALUES: usize = 16;
/// Gaussians summed by one unit of the camera gradient.
const CAMERA_ITEMS: usize = 4;
/// Gaussians summed by one workgroup of the camera gradient.
const CAMERA_BLOCK: usize = CUBE_UNITS_USIZE * CAMERA_ITEMS;

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
                mean_x += grad.camera.mean.x;
                mean_y += grad.camera.mean.y;
                mean_z += grad.camera.mean.z;
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
                    sums[0] += grad.camera.w.r0.x;
                    sums[1] += grad.camera.w.r0.y;
                    sums[2] += grad.camera.w.r0.z;
                    sums[3] += grad.camera.t.x;
                    sums[4] += grad.camera.w.r1.x;
                    sums[5] += grad.camera.w.r1.y;
                    sums[6] += grad.camera.w.r1.z;
                    sums[7] += grad.camera.t.y;
                    sums[8] += grad.camera.w.r2.x;
                    sums[9] += grad.camera.w.r2.y;
                    sums[10] += grad.camera.w.r2.z;
                    sums[11] += grad.camera.t.z;
                    sums[12] += grad.camera.fx;
                    sums[13] += grad.camera.fy;
                    sums[14] += grad.camera.cx;
                    sums[15] += grad.camera.cy;
                }
            }
        }
    }
    #[unroll]
    for k in 0..CAMERA_VALUES {
        shared[k * CUBE_UNITS_USIZE + unit] = sums[k];
    }
    sync_cube();
    // 256 units: 16 values with 16 parts each, then 16 units add the parts.
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

/// Adds the blocks' partial gradients of each camera, in order. The last row of a view matrix has
/// no influence.
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

/// Gradients of means [N, 3], quats [N, 4], scales [N, 3], viewmats [C, 4, 4] and intrinsics [C,
/// 4], from the gradient of the packed splats [C, N, 9]; only those that `needs_grad` names.
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
    // A gradient that is not needed still needs a buffer to bind.
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
