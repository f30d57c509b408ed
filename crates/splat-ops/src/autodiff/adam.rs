//! Adam on the autodiff backend: an optimiser step is outside every graph, so its outputs are new
//! leaves.

use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::{Autodiff, AutodiffBackend};

use crate::backend::{AdamInputs, AdamOps, AdamOutputs, OpInputs};
use crate::settings::AdamStep;

impl<B: AdamOps, C: CheckpointStrategy> AdamOps for Autodiff<B, C> {
    fn adam(OpInputs(inputs): AdamInputs<Self>, step: AdamStep) -> AdamOutputs<Self> {
        let stepped = B::adam(OpInputs(inputs.map(|input| input.into_primitive())), step);
        AdamOutputs {
            param: Self::from_inner(stepped.param),
            moment_1: Self::from_inner(stepped.moment_1),
            moment_2: Self::from_inner(stepped.moment_2),
        }
    }
}
