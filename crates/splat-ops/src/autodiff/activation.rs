//! `exp` and `sigmoid`: save input and output, and compute each gradient from the one that is exact
//! for it.

use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::{Autodiff, tensor::FloatTensor};

use tracing::trace_span;

use super::{Saved, record};
use crate::backend::{ActivationBackend, ActivationOps};
use crate::settings::Activation;

#[derive(Debug, Clone)]
struct Activated<B: ActivationBackend> {
    x: FloatTensor<B>,
    y: FloatTensor<B>,
    function: Activation,
}

impl<B: ActivationBackend> Saved<B, 1> for Activated<B> {
    fn gradients(self, grad: FloatTensor<B>, _: [bool; 1]) -> [Option<FloatTensor<B>>; 1] {
        let _span = trace_span!("activations gradient").entered();
        [Some(B::activation_backward(
            self.x,
            self.y,
            grad,
            self.function,
        ))]
    }
}

impl<B: ActivationBackend, C: CheckpointStrategy> ActivationOps for Autodiff<B, C> {
    fn activation(x: FloatTensor<Self>, function: Activation) -> FloatTensor<Self> {
        record::<B, C, Activated<B>, _, 1>(
            [x.node()],
            x.into_primitive(),
            |x| {
                let y = B::activation(x.clone(), function);
                let saved = Activated {
                    x,
                    y: y.clone(),
                    function,
                };
                (y, saved)
            },
            |x| B::activation(x, function),
        )
    }
}
