//! The ops on Burn's autodiff backend. One file per op states what is saved and how the gradient
//! flows.
//!
//! A tracked op has N parents and one output; the backend computes gradients of tracked parents
//! only. Every gradient runs in a `tracing` span of its op's name, at level trace, on the caller's
//! thread.

mod activation;
mod adam;
mod blur;
mod perturb;
mod photometric;
mod project;
mod rasterize;
mod screen_probe;
mod screen_statistics;
mod sh_colors;
mod spherical_harmonics;
mod ssim;

use core::fmt::Debug;
use core::marker::PhantomData;

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, NodeGuard, Ops, OpsKind};
use burn::backend::{Autodiff, Backend, tensor::FloatTensor};

/// State that an op saves for the gradients of its N parents.
trait Saved<B: Backend, const N: usize>: Clone + Debug + Send + 'static {
    /// Gradients of the parents that need one, given the gradient of the output.
    fn gradients(self, grad: FloatTensor<B>, needs_grad: [bool; N]) -> [Option<FloatTensor<B>>; N];
}

/// The backward step of an op that saves `S`.
#[derive(Debug)]
struct Recorded<S>(PhantomData<S>);

impl<B: Backend, S: Saved<B, N>, const N: usize> Backward<B, N> for Recorded<S> {
    type State = S;

    fn backward(self, ops: Ops<S, N>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let parents = ops.parents.map(|parent| parent.map(|parent| parent.id));
        let needs_grad = parents.map(|parent| parent.is_some());
        let gradients = ops.state.gradients(grad, needs_grad);
        for (parent, gradient) in parents.into_iter().zip(gradients) {
            if let (Some(parent), Some(gradient)) = (parent, gradient) {
                grads.register::<B>(parent, gradient);
            }
        }
    }
}

/// Runs an op: `tracked` if a parent is tracked, else `plain`, which keeps nothing.
fn record<B: Backend, C: CheckpointStrategy, S: Saved<B, N>, I, const N: usize>(
    parents: [NodeGuard; N],
    inputs: I,
    tracked: impl FnOnce(I) -> (FloatTensor<B>, S),
    plain: impl FnOnce(I) -> FloatTensor<B>,
) -> FloatTensor<Autodiff<B, C>> {
    let step = Recorded::<S>(PhantomData).prepare::<C>(parents);
    match step.compute_bound().stateful() {
        OpsKind::Tracked(step) => {
            let (output, saved) = tracked(inputs);
            step.finish(saved, output)
        }
        OpsKind::UnTracked(step) => step.finish(plain(inputs)),
    }
}
