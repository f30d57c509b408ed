//! `project`: saves its inputs; the backward pass recomputes the intermediates.

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

impl<B: ProjectBackend> Saved<B, 7> for Project<B> {
    fn gradients(self, grad: FloatTensor<B>, needs_grad: [bool; 7]) -> [Option<FloatTensor<B>>; 7] {
        let _span = trace_span!("project gradient").entered();
        B::project_backward(self.inputs, grad, &self.args, needs_grad.into()).into()
    }
}

impl<B: ProjectBackend, C: CheckpointStrategy> ProjectOps for Autodiff<B, C> {
    fn project(OpInputs(inputs): ProjectInputs<Self>, args: ProjectArgs) -> FloatTensor<Self> {
        // A parent that is absent is one that is not tracked.
        let untracked = || FloatTensor::<Self>::new(inputs.means.primitive().clone()).node();
        let nodes = inputs.inputs().map(|input| match input {
            Some(input) => input.node(),
            None => untracked(),
        });
        record::<B, C, Project<B>, _, 7>(
            nodes.into(),
            OpInputs(inputs.map_inputs(|input| input.into_primitive())),
            |inputs| (B::project(inputs.clone(), args), Project { inputs, args }),
            |inputs| B::project(inputs, args),
        )
    }
}
