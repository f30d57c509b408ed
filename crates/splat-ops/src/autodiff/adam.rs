//! Adam on the autodiff backend: an optimiser step is outside every graph, so its outputs are new
//! leaves.

use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, AutodiffBackend};

use crate::backend::{AdamInputs, AdamOps, AdamOutputs, AdamTensors, OpInputs};
use crate::settings::{AdamGap, AdamStep, RowGroups};

impl<B: AdamOps, C: CheckpointStrategy> AdamOps for Autodiff<B, C> {
    fn adam(OpInputs(inputs): AdamInputs<Self>, step: AdamStep) -> AdamOutputs<Self> {
        leaves(B::adam(inner::<B, C>(inputs), step))
    }

    fn adam_groups(
        OpInputs(inputs): AdamInputs<Self>,
        step: AdamStep,
        rows: RowGroups,
    ) -> AdamOutputs<Self> {
        leaves(B::adam_groups(inner::<B, C>(inputs), step, rows))
    }

    fn adam_catch_up(
        tensors: AdamOutputs<Self>,
        rows: RowGroups,
        gaps: Vec<AdamGap>,
    ) -> AdamOutputs<Self> {
        let inner = AdamOutputs {
            param: tensors.param.into_primitive(),
            moment_1: tensors.moment_1.into_primitive(),
            moment_2: tensors.moment_2.into_primitive(),
        };
        leaves(B::adam_catch_up(inner, rows, gaps))
    }
}

fn inner<B: AdamOps, C: CheckpointStrategy>(
    inputs: AdamTensors<FloatTensor<Autodiff<B, C>>>,
) -> AdamInputs<B> {
    OpInputs(inputs.map(|input| input.into_primitive()))
}

fn leaves<B: AdamOps, C: CheckpointStrategy>(
    stepped: AdamOutputs<B>,
) -> AdamOutputs<Autodiff<B, C>> {
    AdamOutputs {
        param: Autodiff::<B, C>::from_inner(stepped.param),
        moment_1: Autodiff::<B, C>::from_inner(stepped.moment_1),
        moment_2: Autodiff::<B, C>::from_inner(stepped.moment_2),
    }
}
