//! `sh_colors`: saves its inputs. At degree 0 the degree 0 coefficients are the only parent; `seen`
//! never is a parent.

use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::{Autodiff, tensor::FloatTensor};

use tracing::trace_span;

use super::{Saved, record};
use crate::ShColorSettings;
use crate::backend::{
    OpInputs, ShColorGradients, ShColorInputs, ShColorTensors, ShColorsBackend, ShColorsOps,
    ShLayout,
};

#[derive(Debug, Clone)]
struct ShColors<B: ShColorsBackend> {
    inputs: ShColorInputs<B>,
    layout: ShLayout<B>,
    settings: ShColorSettings,
}

impl<B: ShColorsBackend> ShColors<B> {
    fn new(
        inputs: ShColorInputs<B>,
        layout: ShLayout<B>,
        settings: ShColorSettings,
    ) -> (FloatTensor<B>, Self) {
        let colors = B::sh_colors(inputs.clone(), layout.clone(), settings);
        let saved = Self {
            inputs,
            layout,
            settings,
        };
        (colors, saved)
    }

    fn backward(
        self,
        grad: FloatTensor<B>,
        needs_grad: ShColorTensors<bool>,
    ) -> ShColorGradients<B> {
        let _span = trace_span!("colours gradient").entered();
        B::sh_colors_backward(self.inputs, self.layout, grad, self.settings, needs_grad)
    }
}

impl<B: ShColorsBackend> Saved<B, 1> for ShColors<B> {
    fn gradients(self, grad: FloatTensor<B>, [sh0]: [bool; 1]) -> [Option<FloatTensor<B>>; 1] {
        let needs_grad = ShColorTensors {
            sh0,
            ..Default::default()
        };
        [self.backward(grad, needs_grad).sh0]
    }
}

impl<B: ShColorsBackend> Saved<B, 4> for ShColors<B> {
    fn gradients(
        self,
        grad: FloatTensor<B>,
        [sh0, sh_rest, means, centers]: [bool; 4],
    ) -> [Option<FloatTensor<B>>; 4] {
        let needs_grad = ShColorTensors {
            sh0,
            sh_rest,
            means,
            centers,
            seen: false,
        };
        let grads = self.backward(grad, needs_grad);
        [grads.sh0, grads.sh_rest, grads.means, grads.centers]
    }
}

impl<B: ShColorsBackend, C: CheckpointStrategy> ShColorsOps for Autodiff<B, C> {
    fn sh_colors(
        OpInputs(inputs): ShColorInputs<Self>,
        layout: ShLayout<Self>,
        settings: ShColorSettings,
    ) -> FloatTensor<Self> {
        let sh0 = inputs.sh0.node();
        let others = inputs
            .sh_rest
            .as_ref()
            .map(|rest| [rest, &inputs.means, &inputs.centers].map(|input| input.node()));
        let inputs = OpInputs(inputs.map_inputs(|input| input.into_primitive()));
        let layout = match layout {
            ShLayout::Uniform => ShLayout::Uniform,
            ShLayout::Ragged(starts) => ShLayout::Ragged(starts),
        };
        let inputs = (inputs, layout);
        let tracked = |(inputs, layout)| ShColors::new(inputs, layout, settings);
        let plain = |(inputs, layout)| B::sh_colors(inputs, layout, settings);
        match others {
            Some([rest, means, centers]) => record::<B, C, ShColors<B>, _, 4>(
                [sh0, rest, means, centers],
                inputs,
                tracked,
                plain,
            ),
            None => record::<B, C, ShColors<B>, _, 1>([sh0], inputs, tracked, plain),
        }
    }
}
