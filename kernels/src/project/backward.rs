//! Gradients of all Gaussians and cameras.

use cubecl::prelude::*;
use splat_core::{CameraModel, ImageSize, PROJECTED_WIDTH, ProjectSettings, ProjectTensors};

use super::camera::Camera;
use super::splat::{Gaussian, project_splat};
use super::vjp::project_vjp;
use super::{ProjectInputs, Uniforms, cameras, gaussians, uniforms};
use crate::launch::{Buffer, CUBE_UNITS, CUBE_UNITS_USIZE, cube_count, per_element};
use crate::math::{Quat, Vec3};

/// Values of a camera's gradient: three rows [W | t], then fx, fy, cx, cy, then the coefficients of
/// the lens.
const fn camera_values(model: CameraModel) -> usize {
    16 + model.coefficients()
}

/// Entries that one unit adds up, of those of all units of a workgroup for one value. A power of
/// two, which divides the units, and enough that the units suffice for all values.
const fn camera_share(model: CameraModel) -> usize {
    camera_values(model).next_power_of_two()
}

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
    distortion: ComptimeOption<&[f32]>,
    domain: ComptimeOption<&[f32]>,
    grad_packed: &[f32],
    grad_means: &mut [f32],
    grad_quats: &mut [f32],
    grad_scales: &mut [f32],
    gaussians: u32,
    cameras: u32,
    s: Uniforms,
    #[comptime] model: CameraModel,
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
            let camera = Camera::load(viewmats, intrinsics, &distortion, &domain, c, model);
            let splat = project_splat(g, camera, s, model);
            if splat.visible {
                let at = (c * gaussians + index) * PROJECTED_WIDTH;
                let grad = project_vjp(g, camera, splat, grad_packed, at, s, model);
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
    distortion: ComptimeOption<&[f32]>,
    domain: ComptimeOption<&[f32]>,
    grad_packed: &[f32],
    partials: &mut [f32],
    gaussians: u32,
    cameras: u32,
    blocks: u32,
    s: Uniforms,
    #[comptime] model: CameraModel,
) {
    let values = comptime!(camera_values(model));
    let mut shared = Shared::new_slice(comptime!(camera_values(model) * CUBE_UNITS_USIZE));
    let mut parts = Shared::new_slice(CUBE_UNITS_USIZE);
    let gaussians = gaussians as usize;
    let blocks = blocks as usize;
    let unit = UNIT_POS as usize;
    let c = CUBE_POS / blocks;
    let block = CUBE_POS % blocks;

    let mut sums = Array::<f32>::new(values);
    #[unroll]
    for k in 0..values {
        sums[k] = 0.0f32;
    }
    if c < cameras as usize {
        let camera = Camera::load(viewmats, intrinsics, &distortion, &domain, c, model);
        for item in 0..CAMERA_ITEMS {
            let index = block * CAMERA_BLOCK + item * CUBE_UNITS_USIZE + unit;
            if index < gaussians {
                let g = Gaussian::load(means, quats, scales, index);
                let splat = project_splat(g, camera, s, model);
                if splat.visible {
                    let at = (c * gaussians + index) * PROJECTED_WIDTH;
                    let grad = project_vjp(g, camera, splat, grad_packed, at, s, model);
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
                    if comptime!(model != CameraModel::Pinhole) {
                        sums[16] += grad.camera.k.c0;
                        sums[17] += grad.camera.k.c1;
                        sums[18] += grad.camera.k.c2;
                        sums[19] += grad.camera.k.c3;
                    }
                    if comptime!(model == CameraModel::OpenCv) {
                        sums[20] += grad.camera.k.c4;
                        sums[21] += grad.camera.k.c5;
                        sums[22] += grad.camera.k.c6;
                        sums[23] += grad.camera.k.c7;
                    }
                }
            }
        }
    }
    #[unroll]
    for k in 0..values {
        shared[k * CUBE_UNITS_USIZE + unit] = sums[k];
    }
    sync_cube();
    // The units of a workgroup share the values, each value in equal parts; then one unit per value
    // adds its parts.
    let share = comptime!(camera_share(model));
    let parts_of_each = comptime!(CUBE_UNITS_USIZE / camera_share(model));
    if unit < values * parts_of_each {
        let mut part = 0.0f32;
        for k in 0..share {
            part += shared[unit * share + k];
        }
        parts[unit] = part;
    }
    sync_cube();
    if unit < values && c < cameras as usize {
        let mut sum = 0.0f32;
        for k in 0..parts_of_each {
            sum += parts[unit * parts_of_each + k];
        }
        partials[CUBE_POS * values + unit] = sum;
    }
}

/// Adds the blocks' partial gradients of each camera, in order. The last row of a view matrix has
/// no influence.
#[cube(launch)]
fn sum_camera_partials(
    partials: &[f32],
    grad_viewmats: &mut [f32],
    grad_intrinsics: &mut [f32],
    grad_distortion: &mut [f32],
    cameras: u32,
    blocks: u32,
    #[comptime] model: CameraModel,
    #[comptime] needs_grad: ProjectTensors<bool>,
) {
    let values = comptime!(camera_values(model));
    let coefficients = comptime!(model.coefficients());
    let c = ABSOLUTE_POS / values;
    let k = ABSOLUTE_POS % values;
    if c < cameras as usize {
        let mut sum = 0.0f32;
        for block in 0..blocks as usize {
            sum += partials[(c * blocks as usize + block) * values + k];
        }
        if k < 12 {
            if comptime!(needs_grad.viewmats) {
                grad_viewmats[c * 16 + k] = sum;
            }
        } else if k < 16 {
            if comptime!(needs_grad.viewmats) {
                grad_viewmats[c * 16 + k] = 0.0f32;
            }
            if comptime!(needs_grad.intrinsics) {
                grad_intrinsics[c * 4 + k - 12] = sum;
            }
        } else if k < comptime!(16 + model.coefficients()) {
            if comptime!(needs_grad.distortion) {
                grad_distortion[c * coefficients + k - 16] = sum;
            }
        }
    }
}

/// Gradients of means [N, 3], quats [N, 4], scales [N, 3], viewmats [C, 4, 4], intrinsics [C, 4]
/// and distortion [C, K], from the gradient of the packed splats [C, N, 9]; only those that
/// `needs_grad` names.
pub fn project_backward(
    client: &Client,
    inputs: &ProjectInputs,
    grad_packed: &Buffer,
    size: ImageSize,
    model: CameraModel,
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
        distortion: cameras * model.coefficients(),
        domain: 0,
    };
    let needs_grad = ProjectTensors {
        domain: false,
        ..needs_grad
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
            inputs.distortion.as_ref().map(Buffer::arg).into(),
            inputs.domain.as_ref().map(Buffer::arg).into(),
            grad_packed.arg(),
            grads.means.arg(),
            grads.quats.arg(),
            grads.scales.arg(),
            gaussians as u32,
            cameras as u32,
            uniforms(size, settings),
            model,
            needs_grad,
        );
    }
    let of_cameras = needs_grad.viewmats || needs_grad.intrinsics || needs_grad.distortion;
    if of_cameras && cameras > 0 {
        let values = camera_values(model);
        let blocks = gaussians.div_ceil(CAMERA_BLOCK);
        let partials = Buffer::empty(client, cameras * blocks * values);
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
                inputs.distortion.as_ref().map(Buffer::arg).into(),
                inputs.domain.as_ref().map(Buffer::arg).into(),
                grad_packed.arg(),
                partials.arg(),
                gaussians as u32,
                cameras as u32,
                blocks as u32,
                uniforms(size, settings),
                model,
            );
        }
        if let Some((count, dim)) = per_element(cameras * values) {
            sum_camera_partials::launch(
                client,
                count,
                dim,
                partials.arg(),
                grads.viewmats.arg(),
                grads.intrinsics.arg(),
                grads.distortion.arg(),
                cameras as u32,
                blocks as u32,
                model,
                needs_grad,
            );
        }
    }
    grads
        .zip(needs_grad)
        .map(|(grad, needed)| needed.then_some(grad))
}
