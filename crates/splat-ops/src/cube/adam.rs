//! One step of Adam on CubeCL devices.

use burn::backend::TensorMetadata;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::adam::{AdamStep as KernelStep, adam};

use super::{buffer, prepare, tensor};
use crate::adam::AdamStep;

/// Parameter, gradient and both moments to parameter and moments after the step.
pub(super) fn step(tensors: [CubeTensor; 4], step: &AdamStep) -> [CubeTensor; 3] {
    let tensors = tensors.map(prepare);
    let step = KernelStep {
        beta_1: step.beta_1,
        beta_2: step.beta_2,
        rate: step.rate,
        epsilon: step.epsilon,
    };
    let buffers = tensors.each_ref().map(buffer);
    let param = &tensors[0];
    adam(&param.client, buffers.each_ref(), &step)
        .map(|buffer| tensor(param, buffer, param.shape()))
}
