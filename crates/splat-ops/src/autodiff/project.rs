//! `project`: saves its five inputs; the backward recomputes what lies between.

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::{Autodiff, tensor::FloatTensor};

use super::register;
use crate::backend::SplatBackend;
use crate::settings::ProjectArgs;

#[derive(Debug)]
struct ProjectBackward;

impl<B: SplatBackend> Backward<B, 5> for ProjectBackward {
    type State = ([FloatTensor<B>; 5], ProjectArgs);

    fn backward(self, ops: Ops<Self::State, 5>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let ([means, quats, scales, viewmats, intrinsics], args) = ops.state;
        let parents = ops.parents.map(|parent| parent.map(|parent| parent.id));
        let wanted = parents.map(|parent| parent.is_some());
        let values = B::project_backward(
            means, quats, scales, viewmats, intrinsics, grad, &args, wanted,
        );
        register::<B, 5>(grads, parents, values);
    }
}

pub(super) fn project<B: SplatBackend, C: CheckpointStrategy>(
    inputs: [FloatTensor<Autodiff<B, C>>; 5],
    args: ProjectArgs,
) -> FloatTensor<Autodiff<B, C>> {
    let prep = ProjectBackward
        .prepare::<C>(inputs.each_ref().map(|input| input.node()))
        .compute_bound()
        .stateful();
    let inputs = inputs.map(|input| input.into_primitive());
    let forward = |[means, quats, scales, viewmats, intrinsics]: [FloatTensor<B>; 5]| {
        B::project_forward(means, quats, scales, viewmats, intrinsics, &args)
    };
    match prep {
        OpsKind::Tracked(prep) => {
            let output = forward(inputs.clone());
            prep.finish((inputs, args), output)
        }
        OpsKind::UnTracked(prep) => prep.finish(forward(inputs)),
    }
}
