//! One step of Adam on CubeCL devices.

use burn::backend::TensorMetadata;
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::Buffer;
use splat_kernels::adam::{adam, adam_catch_up, adam_rows};

use super::{buffer, prepare, taken};
use crate::backend::{AdamInputs, AdamOps, AdamOutputs, AdamTensors, OpInputs};
use crate::settings::{AdamGap, AdamStep, RowGroups};

/// Values of a row.
fn width(param: &CubeTensor) -> usize {
    let shape = param.shape();
    shape.num_elements() / shape[0].max(1)
}

impl AdamOps for CubeBackend {
    fn adam(OpInputs(inputs): AdamInputs<Self>, step: AdamStep) -> AdamOutputs<Self> {
        let AdamTensors {
            param,
            grad,
            moment_1,
            moment_2,
        } = inputs.map(prepare);
        let (width, client) = (width(&param), grad.client.clone());
        outputs([param, moment_1, moment_2], |param, moments| {
            adam(&client, param, &buffer(&grad), moments, &step, width)
        })
    }

    fn adam_groups(
        OpInputs(inputs): AdamInputs<Self>,
        step: AdamStep,
        rows: RowGroups,
    ) -> AdamOutputs<Self> {
        let AdamTensors {
            param,
            grad,
            moment_1,
            moment_2,
        } = inputs.map(prepare);
        let (width, client) = (width(&param), grad.client.clone());
        outputs([param, moment_1, moment_2], |param, moments| {
            adam_rows(&client, param, &buffer(&grad), moments, &step, width, &rows)
        })
    }

    fn adam_catch_up(
        tensors: AdamOutputs<Self>,
        rows: RowGroups,
        gaps: Vec<AdamGap>,
    ) -> AdamOutputs<Self> {
        let tensors = [tensors.param, tensors.moment_1, tensors.moment_2].map(prepare);
        let (width, client) = (width(&tensors[0]), tensors[0].client.clone());
        outputs(tensors, |param, moments| {
            adam_catch_up(&client, param, moments, width, &rows, &gaps)
        })
    }
}

/// Parameter and moments, whose memory the caller gives up, after a step.
fn outputs(
    tensors: [CubeTensor; 3],
    step: impl FnOnce(Buffer, [Buffer; 2]) -> [Buffer; 3],
) -> AdamOutputs<CubeBackend> {
    let [param, moment_1, moment_2] = tensors.map(taken);
    let [stepped, stepped_1, stepped_2] = step(param.0, [moment_1.0, moment_2.0]);
    AdamOutputs {
        param: param.1(stepped),
        moment_1: moment_1.1(stepped_1),
        moment_2: moment_2.1(stepped_2),
    }
}
