//! One step of Adam on CubeCL devices.

use burn::backend::TensorMetadata;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::adam as kernels;

use super::{buffer, prepare, taken};
use crate::adam::{AdamRows, AdamStep};

/// Parameter, gradient and both moments to parameter and moments after the step.
pub(super) fn step(tensors: [CubeTensor; 4], step: &AdamStep) -> [CubeTensor; 3] {
    let [param, grad, moment_1, moment_2] = tensors.map(prepare);
    let shape = param.shape();
    let rows = match step.rows {
        AdamRows::All => kernels::AdamRows::All,
        AdamRows::Seen => kernels::AdamRows::Seen {
            width: shape.num_elements() / shape[0].max(1),
        },
    };
    let kernel = kernels::AdamStep {
        beta_1: step.beta_1,
        beta_2: step.beta_2,
        rate: step.rate,
        epsilon: step.epsilon,
        rows,
    };
    let [param, moment_1, moment_2] = [param, moment_1, moment_2].map(taken);
    let [stepped, stepped_1, stepped_2] = kernels::adam(
        &grad.client,
        param.0,
        &buffer(&grad),
        [moment_1.0, moment_2.0],
        &kernel,
    );
    [
        param.1(stepped),
        moment_1.1(stepped_1),
        moment_2.1(stepped_2),
    ]
}
