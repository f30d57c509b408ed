//! `spherical_harmonics`: saves coefficients and directions.

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::{Autodiff, tensor::FloatTensor};

use super::register;
use crate::backend::SplatBackend;

#[derive(Debug)]
struct SphericalHarmonicsBackward;

impl<B: SplatBackend> Backward<B, 2> for SphericalHarmonicsBackward {
    type State = ([FloatTensor<B>; 2], usize);

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let ([coeffs, dirs], degree) = ops.state;
        let parents = ops.parents.map(|parent| parent.map(|parent| parent.id));
        let wanted = parents.map(|parent| parent.is_some());
        let values = B::spherical_harmonics_backward(coeffs, dirs, grad, degree, wanted);
        register::<B, 2>(grads, parents, values);
    }
}

pub(super) fn spherical_harmonics<B: SplatBackend, C: CheckpointStrategy>(
    inputs: [FloatTensor<Autodiff<B, C>>; 2],
    degree: usize,
) -> FloatTensor<Autodiff<B, C>> {
    let prep = SphericalHarmonicsBackward
        .prepare::<C>(inputs.each_ref().map(|input| input.node()))
        .compute_bound()
        .stateful();
    let inputs = inputs.map(|input| input.into_primitive());
    let forward =
        |[coeffs, dirs]: [FloatTensor<B>; 2]| B::spherical_harmonics_forward(coeffs, dirs, degree);
    match prep {
        OpsKind::Tracked(prep) => {
            let output = forward(inputs.clone());
            prep.finish((inputs, degree), output)
        }
        OpsKind::UnTracked(prep) => prep.finish(forward(inputs)),
    }
}
