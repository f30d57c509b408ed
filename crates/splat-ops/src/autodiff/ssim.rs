//! `ssim`: saves both images and the backend's windowed moments.

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::{Autodiff, tensor::FloatTensor};

use super::register;
use crate::backend::SplatBackend;
use crate::settings::SsimArgs;

#[derive(Debug)]
struct SsimBackward;

#[derive(Debug, Clone)]
struct State<B: SplatBackend> {
    images: [FloatTensor<B>; 2],
    moments: Vec<FloatTensor<B>>,
    args: SsimArgs,
}

impl<B: SplatBackend> Backward<B, 2> for SsimBackward {
    type State = State<B>;

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let parents = ops.parents.map(|parent| parent.map(|parent| parent.id));
        let wanted = parents.map(|parent| parent.is_some());
        let State {
            images,
            moments,
            args,
        } = ops.state;
        let values = B::ssim_backward(images, moments, grad, &args, wanted);
        register::<B, 2>(grads, parents, values);
    }
}

pub(super) fn ssim<B: SplatBackend, C: CheckpointStrategy>(
    images: [FloatTensor<Autodiff<B, C>>; 2],
    args: SsimArgs,
) -> FloatTensor<Autodiff<B, C>> {
    let prep = SsimBackward
        .prepare::<C>(images.each_ref().map(|image| image.node()))
        .compute_bound()
        .stateful();
    let images = images.map(|image| image.into_primitive());
    let (map, moments) = B::ssim_forward(images.clone(), &args);
    match prep {
        OpsKind::Tracked(prep) => {
            let state = State {
                images,
                moments,
                args,
            };
            prep.finish(state, map)
        }
        OpsKind::UnTracked(prep) => prep.finish(map),
    }
}
