//! Noise is no part of any graph: what comes out is a new leaf.

use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, AutodiffBackend};

use crate::backend::{OpInputs, PerturbInputs, PerturbOps};
use crate::settings::Perturbation;

impl<B: PerturbOps, C: CheckpointStrategy> PerturbOps for Autodiff<B, C> {
    fn perturb(OpInputs(inputs): PerturbInputs<Self>, noise: Perturbation) -> FloatTensor<Self> {
        let inputs = OpInputs(inputs.map(|input| input.into_primitive()));
        Self::from_inner(B::perturb(inputs, noise))
    }
}
