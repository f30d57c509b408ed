//! One step of Adam on CubeCL devices.

use burn::backend::TensorMetadata;
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::adam::{AdamStep as KernelStep, adam};

use super::{buffer, prepare, tensor};
use crate::adam::{AdamRows, AdamStep};
use crate::composed;

/// Parameter, gradient and both moments to parameter and moments after the step.
pub(super) fn step(tensors: [CubeTensor; 4], step: &AdamStep) -> [CubeTensor; 3] {
    let tensors = tensors.map(prepare);
    let kernel = KernelStep {
        beta_1: step.beta_1,
        beta_2: step.beta_2,
        rate: step.rate,
        epsilon: step.epsilon,
    };
    let buffers = tensors.each_ref().map(buffer);
    let [param, grad, moment_1, moment_2] = &tensors;
    let after = adam(&param.client, buffers.each_ref(), &kernel)
        .map(|buffer| tensor(param, buffer, param.shape()));
    match step.rows {
        AdamRows::All => after,
        AdamRows::Seen => {
            let before = [param, moment_1, moment_2].map(CubeTensor::clone);
            composed::where_seen::<CubeBackend>(grad.clone(), before, after)
        }
    }
}
