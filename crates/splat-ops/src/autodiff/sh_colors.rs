//! `sh_colors`: saves its inputs. At degree 0 the coefficients of that degree are the only parent; what was seen never is
//! one.

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::{Autodiff, tensor::FloatTensor};

use super::register;
use crate::ShColorSettings;
use crate::backend::{ShInputs, SplatBackend};

#[derive(Debug)]
struct ShColorsBackward;

impl<B: SplatBackend> Backward<B, 1> for ShColorsBackward {
    type State = (ShInputs<B>, ShColorSettings);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let (inputs, settings) = ops.state;
        let parents = ops.parents.map(|parent| parent.map(|parent| parent.id));
        let wanted = [parents[0].is_some(), false, false, false];
        let [sh0, ..] = B::sh_colors_backward(inputs, grad, settings, wanted);
        register::<B, 1>(grads, parents, [sh0]);
    }
}

impl<B: SplatBackend> Backward<B, 4> for ShColorsBackward {
    type State = (ShInputs<B>, ShColorSettings);

    fn backward(self, ops: Ops<Self::State, 4>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let (inputs, settings) = ops.state;
        let parents = ops.parents.map(|parent| parent.map(|parent| parent.id));
        let wanted = parents.map(|parent| parent.is_some());
        let values = B::sh_colors_backward(inputs, grad, settings, wanted);
        register::<B, 4>(grads, parents, values);
    }
}

pub(super) fn sh_colors<B: SplatBackend, C: CheckpointStrategy>(
    sh0: FloatTensor<Autodiff<B, C>>,
    sh_rest: Option<FloatTensor<Autodiff<B, C>>>,
    means: FloatTensor<Autodiff<B, C>>,
    centers: FloatTensor<Autodiff<B, C>>,
    seen: Option<FloatTensor<Autodiff<B, C>>>,
    settings: ShColorSettings,
) -> FloatTensor<Autodiff<B, C>> {
    let inputs = |sh_rest| ShInputs {
        sh0: sh0.clone().into_primitive(),
        sh_rest,
        means: means.clone().into_primitive(),
        centers: centers.clone().into_primitive(),
        seen: seen.map(|seen| seen.into_primitive()),
    };
    match sh_rest {
        Some(rest) => {
            let nodes = [&sh0, &rest, &means, &centers].map(|input| input.node());
            let prep = ShColorsBackward.prepare::<C>(nodes);
            let inputs = inputs(Some(rest.into_primitive()));
            record::<B, C, 4>(prep.compute_bound().stateful(), inputs, settings)
        }
        None => {
            let prep = ShColorsBackward.prepare::<C>([sh0.node()]);
            record::<B, C, 1>(prep.compute_bound().stateful(), inputs(None), settings)
        }
    }
}

fn record<B: SplatBackend, C: CheckpointStrategy, const N: usize>(
    prep: OpsKind<ShColorsBackward, B, (ShInputs<B>, ShColorSettings), C, N>,
    inputs: ShInputs<B>,
    settings: ShColorSettings,
) -> FloatTensor<Autodiff<B, C>>
where
    ShColorsBackward: Backward<B, N, State = (ShInputs<B>, ShColorSettings)>,
{
    match prep {
        OpsKind::Tracked(prep) => {
            let colors = B::sh_colors_forward(inputs.clone(), settings);
            prep.finish((inputs, settings), colors)
        }
        OpsKind::UnTracked(prep) => prep.finish(B::sh_colors_forward(inputs, settings)),
    }
}
