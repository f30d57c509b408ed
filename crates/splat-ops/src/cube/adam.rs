//! One step of Adam on CubeCL devices.

use burn::backend::TensorMetadata;
use burn_cubecl::CubeBackend;
use splat_kernels::adam::adam;

use super::{buffer, prepare, taken};
use crate::backend::{AdamInputs, AdamOps, AdamOutputs, AdamTensors, OpInputs};
use crate::settings::AdamStep;

impl AdamOps for CubeBackend {
    fn adam(OpInputs(inputs): AdamInputs<Self>, step: AdamStep) -> AdamOutputs<Self> {
        let AdamTensors {
            param,
            grad,
            moment_1,
            moment_2,
        } = inputs.map(prepare);
        let shape = param.shape();
        let width = shape.num_elements() / shape[0].max(1);
        let [param, moment_1, moment_2] = [param, moment_1, moment_2].map(taken);
        let [stepped, stepped_1, stepped_2] = adam(
            &grad.client,
            param.0,
            &buffer(&grad),
            [moment_1.0, moment_2.0],
            &step,
            width,
        );
        AdamOutputs {
            param: param.1(stepped),
            moment_1: moment_1.1(stepped_1),
            moment_2: moment_2.1(stepped_2),
        }
    }
}
