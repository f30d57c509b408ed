//! `gaussian_blur`: linear and self-adjoint, so nothing but the window is saved.

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::{Autodiff, tensor::FloatTensor};

use super::register;
use crate::backend::SplatBackend;

#[derive(Debug)]
struct BlurBackward;

impl<B: SplatBackend> Backward<B, 1> for BlurBackward {
    type State = Vec<f64>;

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let parents = ops.parents.map(|parent| parent.map(|parent| parent.id));
        let value = parents[0]
            .is_some()
            .then(|| B::gaussian_blur(grad, &ops.state));
        register::<B, 1>(grads, parents, [value]);
    }
}

pub(super) fn gaussian_blur<B: SplatBackend, C: CheckpointStrategy>(
    image: FloatTensor<Autodiff<B, C>>,
    window: Vec<f64>,
) -> FloatTensor<Autodiff<B, C>> {
    let prep = BlurBackward
        .prepare::<C>([image.node()])
        .compute_bound()
        .stateful();
    let output = B::gaussian_blur(image.into_primitive(), &window);
    match prep {
        OpsKind::Tracked(prep) => prep.finish(window, output),
        OpsKind::UnTracked(prep) => prep.finish(output),
    }
}
