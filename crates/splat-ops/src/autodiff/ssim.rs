//! `ssim`: saves both images and the backend's windowed moments.

use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::{Autodiff, tensor::FloatTensor};

use tracing::trace_span;

use super::{Saved, record};
use crate::backend::{OpInputs, SsimBackend, SsimInputs, SsimOps};
use crate::settings::SsimArgs;

#[derive(Debug, Clone)]
struct Ssim<B: SsimBackend> {
    inputs: SsimInputs<B>,
    moments: Vec<FloatTensor<B>>,
    args: SsimArgs,
}

impl<B: SsimBackend> Saved<B, 2> for Ssim<B> {
    fn gradients(self, grad: FloatTensor<B>, needs_grad: [bool; 2]) -> [Option<FloatTensor<B>>; 2] {
        let _span = trace_span!("ssim gradient").entered();
        B::ssim_backward(
            self.inputs,
            self.moments,
            grad,
            &self.args,
            needs_grad.into(),
        )
        .into()
    }
}

impl<B: SsimBackend, C: CheckpointStrategy> SsimOps for Autodiff<B, C> {
    fn ssim(OpInputs(inputs): SsimInputs<Self>, args: SsimArgs) -> FloatTensor<Self> {
        record::<B, C, Ssim<B>, _, 2>(
            <[_; 2]>::from(inputs.clone()).map(|image| image.node()),
            (OpInputs(inputs.map(|image| image.into_primitive())), args),
            |(inputs, args)| {
                let (map, moments) = B::ssim_tracked(inputs.clone(), &args);
                (
                    map,
                    Ssim {
                        inputs,
                        moments,
                        args,
                    },
                )
            },
            |(inputs, args)| B::ssim(inputs, args),
        )
    }
}
