//! `rasterize`: saves its inputs and the backend's lists of splats per tile.
//!
//! An op has one output, so the absolute gradients of the screen means, a second result of the
//! backward pass, come out as the gradient of a parent that the image does not depend on.

use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::{Autodiff, tensor::FloatTensor};

use tracing::trace_span;

use super::{Saved, record};
use crate::backend::{
    OpInputs, RasterizeBackend, RasterizeGradients, RasterizeInputs, RasterizeOps, RasterizeTensors,
};
use crate::settings::RasterizeArgs;

#[derive(Debug, Clone)]
struct Rasterize<B: RasterizeBackend> {
    inputs: RasterizeInputs<B>,
    state: B::RasterizeState,
    args: RasterizeArgs,
}

impl<B: RasterizeBackend> Rasterize<B> {
    fn new(inputs: RasterizeInputs<B>, args: RasterizeArgs) -> (FloatTensor<B>, Self) {
        let args = RasterizeArgs {
            backward: true,
            ..args
        };
        let (output, state) = B::rasterize_tracked(inputs.clone(), &args);
        (
            output,
            Self {
                inputs,
                state,
                args,
            },
        )
    }

    fn backward(
        self,
        grad: FloatTensor<B>,
        needs_grad: RasterizeTensors<bool>,
    ) -> RasterizeGradients<B> {
        let _span = trace_span!("rasterize gradient").entered();
        B::rasterize_backward(self.inputs, self.state, grad, &self.args, needs_grad)
    }
}

impl<B: RasterizeBackend> Saved<B, 5> for Rasterize<B> {
    fn gradients(self, grad: FloatTensor<B>, needs_grad: [bool; 5]) -> [Option<FloatTensor<B>>; 5] {
        self.backward(grad, needs_grad.into()).into()
    }
}

impl<B: RasterizeBackend, C: CheckpointStrategy> RasterizeOps for Autodiff<B, C> {
    fn rasterize(
        OpInputs(mut inputs): RasterizeInputs<Self>,
        args: RasterizeArgs,
    ) -> FloatTensor<Self> {
        // Absolute gradients that nobody will read are not asked for.
        inputs.absgrad = inputs.absgrad.filter(|leaf| leaf.is_tracked());
        // A parent that is absent is one that is not tracked.
        let untracked = || FloatTensor::<Self>::new(inputs.packed.primitive().clone()).node();
        let nodes = inputs.inputs().map(|input| match input {
            Some(input) => input.node(),
            None => untracked(),
        });
        let inputs = (
            OpInputs(inputs.map_inputs(|input| input.into_primitive())),
            args,
        );
        record::<B, C, Rasterize<B>, _, 5>(
            nodes.into(),
            inputs,
            |(inputs, args)| Rasterize::new(inputs, args),
            |(inputs, args)| B::rasterize(inputs, args),
        )
    }
}
