//! `screen_probe`: splats pass unchanged, and so does their gradient, which the probe gets too.

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::{Autodiff, tensor::FloatTensor};

use super::register;
use crate::backend::SplatBackend;

#[derive(Debug)]
struct ScreenProbeBackward;

impl<B: SplatBackend> Backward<B, 2> for ScreenProbeBackward {
    type State = ();

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let parents = ops.parents.map(|parent| parent.map(|parent| parent.id));
        register::<B, 2>(grads, parents, [Some(grad.clone()), Some(grad)]);
    }
}

pub(super) fn screen_probe<B: SplatBackend, C: CheckpointStrategy>(
    packed: FloatTensor<Autodiff<B, C>>,
    probe: FloatTensor<Autodiff<B, C>>,
) -> FloatTensor<Autodiff<B, C>> {
    let prep = ScreenProbeBackward
        .prepare::<C>([packed.node(), probe.node()])
        .compute_bound()
        .stateful();
    let packed = packed.into_primitive();
    match prep {
        OpsKind::Tracked(prep) => prep.finish((), packed),
        OpsKind::UnTracked(prep) => prep.finish(packed),
    }
}
