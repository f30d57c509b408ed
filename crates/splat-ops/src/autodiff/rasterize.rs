//! `rasterize`: saves its inputs, its output and the backend's lists of splats per tile. With a
//! background it has four parents, without one three.

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::{Autodiff, tensor::FloatTensor};

use super::register;
use crate::backend::{Optional, SplatBackend};
use crate::settings::RasterizeArgs;

#[derive(Debug)]
struct RasterizeBackward;

#[derive(Debug, Clone)]
struct State<B: SplatBackend> {
    inputs: [FloatTensor<B>; 3],
    background: Option<FloatTensor<B>>,
    output: FloatTensor<B>,
    lists: B::RasterizeState,
    args: RasterizeArgs,
}

impl<B: SplatBackend> State<B> {
    fn gradients(self, grad: FloatTensor<B>, wanted: [bool; 4]) -> [Option<FloatTensor<B>>; 4] {
        let [packed, colors, opacities] = self.inputs;
        B::rasterize_backward(
            packed,
            colors,
            opacities,
            self.background,
            self.output,
            self.lists,
            grad,
            &self.args,
            wanted,
        )
    }
}

impl<B: SplatBackend> Backward<B, 3> for RasterizeBackward {
    type State = State<B>;

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let parents = ops.parents.map(|parent| parent.map(|parent| parent.id));
        let [packed, colors, opacities] = parents.map(|parent| parent.is_some());
        let [packed, colors, opacities, _] = ops
            .state
            .gradients(grad, [packed, colors, opacities, false]);
        register::<B, 3>(grads, parents, [packed, colors, opacities]);
    }
}

impl<B: SplatBackend> Backward<B, 4> for RasterizeBackward {
    type State = State<B>;

    fn backward(self, ops: Ops<Self::State, 4>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let parents = ops.parents.map(|parent| parent.map(|parent| parent.id));
        let wanted = parents.map(|parent| parent.is_some());
        let values = ops.state.gradients(grad, wanted);
        register::<B, 4>(grads, parents, values);
    }
}

pub(super) fn rasterize<B: SplatBackend, C: CheckpointStrategy>(
    inputs: [FloatTensor<Autodiff<B, C>>; 3],
    background: Optional<Autodiff<B, C>>,
    args: RasterizeArgs,
) -> FloatTensor<Autodiff<B, C>> {
    let [packed, colors, opacities] = inputs.each_ref().map(|input| input.node());
    match background {
        Optional::Some(background) => record::<B, C, 4>(
            RasterizeBackward
                .prepare::<C>([packed, colors, opacities, background.node()])
                .compute_bound()
                .stateful(),
            inputs,
            Some(background),
            args,
        ),
        Optional::None => record::<B, C, 3>(
            RasterizeBackward
                .prepare::<C>([packed, colors, opacities])
                .compute_bound()
                .stateful(),
            inputs,
            None,
            args,
        ),
    }
}

fn record<B: SplatBackend, C: CheckpointStrategy, const N: usize>(
    prep: OpsKind<RasterizeBackward, B, State<B>, C, N>,
    inputs: [FloatTensor<Autodiff<B, C>>; 3],
    background: Option<FloatTensor<Autodiff<B, C>>>,
    mut args: RasterizeArgs,
) -> FloatTensor<Autodiff<B, C>>
where
    RasterizeBackward: Backward<B, N, State = State<B>>,
{
    let inputs = inputs.map(|input| input.into_primitive());
    let background = background.map(|background| background.into_primitive());
    let [packed, colors, opacities] = inputs.clone();
    args.backward = matches!(prep, OpsKind::Tracked(_));
    let (output, lists) =
        B::rasterize_forward(packed, colors, opacities, background.clone(), &args);
    match prep {
        OpsKind::Tracked(prep) => {
            let state = State {
                inputs,
                background,
                output: output.clone(),
                lists,
                args,
            };
            prep.finish(state, output)
        }
        OpsKind::UnTracked(prep) => prep.finish(output),
    }
}
