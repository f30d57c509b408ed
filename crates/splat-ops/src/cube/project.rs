//! Projection on CubeCL devices.

use burn::backend::TensorMetadata;
use burn::tensor::Shape;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::project::{ProjectInputs, project, project_backward};

use super::{buffer, prepare, tensor};
use crate::backend::PROJECTED_WIDTH;
use crate::settings::ProjectArgs;

fn inputs(tensors: &[CubeTensor; 5]) -> ProjectInputs {
    let [means, quats, scales, viewmats, intrinsics] = tensors.each_ref().map(buffer);
    ProjectInputs {
        means,
        quats,
        scales,
        viewmats,
        intrinsics,
    }
}

/// Packed splats `[C, N, 9]`.
pub(super) fn forward(tensors: [CubeTensor; 5], args: &ProjectArgs) -> CubeTensor {
    let tensors = tensors.map(prepare);
    let shape = [
        tensors[3].shape()[0],
        tensors[0].shape()[0],
        PROJECTED_WIDTH,
    ];
    let means = &tensors[0];
    let packed = project(&means.client, &inputs(&tensors), args.size, &args.settings);
    tensor(means, packed, Shape::from(shape))
}

/// The wanted gradients of the five inputs.
pub(super) fn backward(
    tensors: [CubeTensor; 5],
    grad_packed: CubeTensor,
    args: &ProjectArgs,
    wanted: [bool; 5],
) -> [Option<CubeTensor>; 5] {
    let tensors = tensors.map(prepare);
    let grad_packed = prepare(grad_packed);
    let mut grads = project_backward(
        &grad_packed.client,
        &inputs(&tensors),
        &buffer(&grad_packed),
        args.size,
        &args.settings,
        wanted,
    );
    core::array::from_fn(|i| {
        let grad = grads[i].take()?;
        Some(tensor(&tensors[i], grad, tensors[i].shape()))
    })
}
