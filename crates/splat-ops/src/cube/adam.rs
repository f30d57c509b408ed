//! One step of Adam on CubeCL devices.

use burn::backend::TensorMetadata;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::adam as kernels;

use super::{buffer, prepare, taken};
use crate::settings::AdamStep;

/// Parameter, gradient and both moments to parameter and moments after the step.
pub(super) fn step(tensors: [CubeTensor; 4], step: &AdamStep) -> [CubeTensor; 3] {
    let [param, grad, moment_1, moment_2] = tensors.map(prepare);
    let shape = param.shape();
    let width = shape.num_elements() / shape[0].max(1);
    let [param, moment_1, moment_2] = [param, moment_1, moment_2].map(taken);
    let [stepped, stepped_1, stepped_2] = kernels::adam(
        &grad.client,
        param.0,
        &buffer(&grad),
        [moment_1.0, moment_2.0],
        step,
        width,
    );
    [
        param.1(stepped),
        moment_1.1(stepped_1),
        moment_2.1(stepped_2),
    ]
}
