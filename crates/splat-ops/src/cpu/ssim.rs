//! Structural similarity per pixel, composed of tensor ops, as training does not need it.

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;

use crate::backend::{OpInputs, SsimBackend, SsimGradients, SsimInputs, SsimOps, SsimTensors};
use crate::composed;
use crate::settings::SsimArgs;

impl SsimOps for Flex {
    fn ssim(inputs: SsimInputs<Self>, args: SsimArgs) -> FlexTensor {
        Self::ssim_tracked(inputs, &args).0
    }
}

impl SsimBackend for Flex {
    fn ssim_tracked(
        OpInputs(inputs): SsimInputs<Self>,
        args: &SsimArgs,
    ) -> (FlexTensor, Vec<FlexTensor>) {
        composed::ssim_forward::<Self>(inputs, args)
    }

    fn ssim_backward(
        OpInputs(inputs): SsimInputs<Self>,
        moments: Vec<FlexTensor>,
        grad_map: FlexTensor,
        args: &SsimArgs,
        needs_grad: SsimTensors<bool>,
    ) -> SsimGradients<Self> {
        composed::ssim_backward::<Self>(inputs, &moments, grad_map, args, needs_grad)
    }
}
