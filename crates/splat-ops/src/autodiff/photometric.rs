//! `photometric`: saves both images and what the backend has made in passing for the gradient.

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::{Autodiff, tensor::FloatTensor};

use super::register;
use crate::backend::{SplatBackend, Target};
use crate::settings::SsimArgs;

#[derive(Debug)]
struct PhotometricBackward;

#[derive(Debug, Clone)]
struct State<B: SplatBackend> {
    rendered: FloatTensor<B>,
    target: Target<B>,
    kept: FloatTensor<B>,
    args: SsimArgs,
}

impl<B: SplatBackend> Backward<B, 1> for PhotometricBackward {
    type State = State<B>;

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let parents = ops.parents.map(|parent| parent.map(|parent| parent.id));
        let State {
            rendered,
            target,
            kept,
            args,
        } = ops.state;
        let value = parents[0]
            .is_some()
            .then(|| B::photometric_backward(rendered, target, kept, grad, &args));
        register::<B, 1>(grads, parents, [value]);
    }
}

pub(super) fn photometric<B: SplatBackend, C: CheckpointStrategy>(
    rendered: FloatTensor<Autodiff<B, C>>,
    target: Target<Autodiff<B, C>>,
    args: SsimArgs,
) -> FloatTensor<Autodiff<B, C>> {
    let prep = PhotometricBackward
        .prepare::<C>([rendered.node()])
        .compute_bound()
        .stateful();
    let rendered = rendered.into_primitive();
    let target = match target {
        Target::Levels(levels) => Target::Levels(levels),
        Target::Values(values) => Target::Values(values.into_primitive()),
    };
    match prep {
        OpsKind::Tracked(prep) => {
            let (means, kept) = B::photometric_tracked(rendered.clone(), target.clone(), &args);
            let state = State {
                rendered,
                target,
                kept,
                args,
            };
            prep.finish(state, means)
        }
        OpsKind::UnTracked(prep) => prep.finish(B::photometric(rendered, target, &args)),
    }
}
