//! `rasterize`: saves its inputs and the backend's lists of splats per tile. With a background it
//! has four parents, without one three.

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

impl<B: RasterizeBackend> Saved<B, 3> for Rasterize<B> {
    fn gradients(
        self,
        grad: FloatTensor<B>,
        [packed, colors, opacities]: [bool; 3],
    ) -> [Option<FloatTensor<B>>; 3] {
        let needs_grad = RasterizeTensors {
            packed,
            colors,
            opacities,
            background: false,
        };
        let grads = self.backward(grad, needs_grad);
        [grads.packed, grads.colors, grads.opacities]
    }
}

impl<B: RasterizeBackend> Saved<B, 4> for Rasterize<B> {
    fn gradients(self, grad: FloatTensor<B>, needs_grad: [bool; 4]) -> [Option<FloatTensor<B>>; 4] {
        self.backward(grad, needs_grad.into()).into()
    }
}

impl<B: RasterizeBackend, C: CheckpointStrategy> RasterizeOps for Autodiff<B, C> {
    fn rasterize(
        OpInputs(inputs): RasterizeInputs<Self>,
        args: RasterizeArgs,
    ) -> FloatTensor<Self> {
        let [packed, colors, opacities] =
            [&inputs.packed, &inputs.colors, &inputs.opacities].map(|input| input.node());
        let background = inputs.background.as_ref().map(|input| input.node());
        let inputs = (
            OpInputs(inputs.map_inputs(|input| input.into_primitive())),
            args,
        );
        let tracked = |(inputs, args)| Rasterize::new(inputs, args);
        let plain = |(inputs, args)| B::rasterize(inputs, args);
        match background {
            Some(background) => record::<B, C, Rasterize<B>, _, 4>(
                [packed, colors, opacities, background],
                inputs,
                tracked,
                plain,
            ),
            None => record::<B, C, Rasterize<B>, _, 3>(
                [packed, colors, opacities],
                inputs,
                tracked,
                plain,
            ),
        }
    }
}
