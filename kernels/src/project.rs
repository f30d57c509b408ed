//! Projection of 3D Gaussians to screen splats, and its vector-Jacobian product (3DGS section 4;
//! gsplat appendix).
//!
//! Per camera and Gaussian, with W, t the view matrix, R the rotation of the normalised quaternion,
//! s the scale, here for a pinhole (`opencv.rs` and `fisheye.rs` have other mean2d and J):
//! ```text
//! p = W mean + t = (x, y, z)                      mean2d = (fx x/z + cx, fy y/z + cy)
//! u = clamp(x/z), v = clamp(y/z)                  J = [fx/z, 0, -fx u/z; 0, fy/z, -fy v/z]
//! V = J W R diag(s), rows V1, V2                  m = V1 x V2
//! a = |V1|² + e, b = V1·V2                        det = |m|² + e(|V1|² + |V2|²) + e²
//! w11 = 1/√a, w22 = √(a/det), w21 = -(b/a) w22    compensation = |m| / √det
//! ```
//! The determinant is a sum of non-negative terms (Cauchy-Binet), so needles keep their precision.
//! V and e are in units of the splat's own size (k pixels), so that nothing overflows or
//! underflows, whether the splat is a millionth of a pixel or a million images wide. Floor per
//! Gaussian and camera: 40 bytes read, 36 written, about 150 operations. Gradients: 76 bytes read,
//! 40 written, and 76 more read for the gradients of cameras.
//!
//! One unit projects one Gaussian to one camera (`splat.rs`, using `camera.rs`; gradients in
//! `vjp.rs`). Gradients of Gaussians are summed over cameras inside one unit; gradients of cameras
//! over blocks of Gaussians and then over the blocks, always in the same order and without atomics.

mod backward;
mod camera;
mod distorted;
mod fisheye;
mod opencv;
mod pinhole;
mod splat;
mod vjp;

use cubecl::prelude::*;
use splat_core::{
    CameraModel, ImageSize, PROJECTED_DEPTH, PROJECTED_WIDTH, ProjectSettings, ProjectTensors,
};

pub use self::backward::project_backward;
use self::camera::Camera;
use self::splat::{Gaussian, project_splat};
use crate::bytes::{Bytes, Sizes};
use crate::launch::{Buffer, per_element};

/// Image size and [`ProjectSettings`] on the device. `blur` = √e; `reach` = √(2 ln(1/alpha_min)),
/// the standard deviations to the edge of a splat.
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

/// The inputs of the projection; distortion and domain where the model has them.
pub type ProjectInputs = ProjectTensors<Buffer, Option<Buffer>>;

fn gaussians(inputs: &ProjectInputs) -> usize {
    (inputs.means.len() / 3)
        .min(inputs.quats.len() / 4)
        .min(inputs.scales.len() / 3)
}

fn cameras(inputs: &ProjectInputs) -> usize {
    (inputs.viewmats.len() / 16).min(inputs.intrinsics.len() / 4)
}

#[cube(launch)]
fn project_forward(
    means: &[f32],
    quats: &[f32],
    scales: &[f32],
    viewmats: &[f32],
    intrinsics: &[f32],
    distortion: ComptimeOption<&[f32]>,
    domain: ComptimeOption<&[f32]>,
    packed: &mut [f32],
    gaussians: u32,
    cameras: u32,
    s: Uniforms,
    #[comptime] model: CameraModel,
) {
    let gaussians = gaussians as usize;
    let index = ABSOLUTE_POS;
    if index < gaussians * cameras as usize {
        let g = Gaussian::load(means, quats, scales, index % gaussians);
        let c = index / gaussians;
        let camera = Camera::load(viewmats, intrinsics, &distortion, &domain, c, model);
        let splat = project_splat(g, camera, s, model);
        let at = index * PROJECTED_WIDTH;
        if splat.visible {
            packed[at] = splat.sight.mean_x;
            packed[at + 1] = splat.sight.mean_y;
            packed[at + PROJECTED_DEPTH] = splat.sight.depth;
            packed[at + 3] = splat.w11 / splat.covariance.k;
            packed[at + 4] = splat.w21 / splat.covariance.k;
            packed[at + 5] = splat.w22 / splat.covariance.k;
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

/// Floors of the forward pass and of the gradient of the Gaussians, for one camera.
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

/// Projects every Gaussian to every camera: packed splats [C, N, 9], zero if culled.
pub fn project(
    client: &Client,
    inputs: &ProjectInputs,
    size: ImageSize,
    model: CameraModel,
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
            inputs.distortion.as_ref().map(Buffer::arg).into(),
            inputs.domain.as_ref().map(Buffer::arg).into(),
            packed.arg(),
            gaussians as u32,
            cameras as u32,
            uniforms(size, settings),
            model,
        );
    }
    packed
}
