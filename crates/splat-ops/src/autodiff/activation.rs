//! `exp` and `sigmoid`: save input and output; each gradient takes what is exact for it.

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::{Autodiff, tensor::FloatTensor};

use super::register;
use crate::backend::SplatBackend;
use crate::settings::Activation;

#[derive(Debug)]
struct ActivationBackward;

impl<B: SplatBackend> Backward<B, 1> for ActivationBackward {
    type State = ([FloatTensor<B>; 2], Activation);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let ([x, y], function) = ops.state;
        let parents = ops.parents.map(|parent| parent.map(|parent| parent.id));
        let value = parents[0]
            .is_some()
            .then(|| B::activate_backward(x, y, grad, function));
        register::<B, 1>(grads, parents, [value]);
    }
}

pub(super) fn activation<B: SplatBackend, C: CheckpointStrategy>(
    x: FloatTensor<Autodiff<B, C>>,
    function: Activation,
) -> FloatTensor<Autodiff<B, C>> {
    let prep = ActivationBackward
        .prepare::<C>([x.node()])
        .compute_bound()
        .stateful();
    let x = x.into_primitive();
    match prep {
        OpsKind::Tracked(prep) => {
            let y = B::activate(x.clone(), function);
            prep.finish(([x, y.clone()], function), y)
        }
        OpsKind::UnTracked(prep) => prep.finish(B::activate(x, function)),
    }
}
