//! `project`: saves its five inputs; the backward pass recomputes the intermediates.

use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::{Autodiff, tensor::FloatTensor};

use tracing::trace_span;

use super::{Saved, record};
use crate::backend::{OpInputs, ProjectBackend, ProjectInputs, ProjectOps};
use crate::settings::ProjectArgs;

#[derive(Debug, Clone)]
struct Project<B: ProjectBackend> {
    inputs: ProjectInputs<B>,
    args: ProjectArgs,
}

impl<B: ProjectBackend> Saved<B, 5> for Project<B> {
    fn gradients(self, grad: FloatTensor<B>, needs_grad: [bool; 5]) -> [Option<FloatTensor<B>>; 5] {
        let _span = trace_span!("project gradient").entered();
        B::project_backward(self.inputs, grad, &self.args, needs_grad.into()).into()
    }
}

impl<B: ProjectBackend, C: CheckpointStrategy> ProjectOps for Autodiff<B, C> {
    fn project(OpInputs(inputs): ProjectInputs<Self>, args: ProjectArgs) -> FloatTensor<Self> {
        record::<B, C, Project<B>, _, 5>(
            <[_; 5]>::from(inputs.clone()).map(|input| input.node()),
            OpInputs(inputs.map(|input| input.into_primitive())),
            |inputs| (B::project(inputs.clone(), args), Project { inputs, args }),
            |inputs| B::project(inputs, args),
        )
    }
}
