//! `gaussian_blur`: linear and self-adjoint, so only the window is saved.

use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::{Autodiff, tensor::FloatTensor};

use tracing::trace_span;

use super::{Saved, record};
use crate::backend::BlurOps;

#[derive(Debug, Clone)]
struct Blur {
    window: Vec<f64>,
}

impl<B: BlurOps> Saved<B, 1> for Blur {
    fn gradients(self, grad: FloatTensor<B>, _: [bool; 1]) -> [Option<FloatTensor<B>>; 1] {
        let _span = trace_span!("blur").entered();
        [Some(B::gaussian_blur(grad, self.window))]
    }
}

impl<B: BlurOps, C: CheckpointStrategy> BlurOps for Autodiff<B, C> {
    fn gaussian_blur(image: FloatTensor<Self>, window: Vec<f64>) -> FloatTensor<Self> {
        record::<B, C, Blur, _, 1>(
            [image.node()],
            (image.into_primitive(), window),
            |(image, window)| (B::gaussian_blur(image, window.clone()), Blur { window }),
            |(image, window)| B::gaussian_blur(image, window),
        )
    }
}
