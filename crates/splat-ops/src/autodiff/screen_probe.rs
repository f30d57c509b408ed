//! `screen_probe`: passes splats and their gradient through unchanged, and gives the gradient to
//! the probe too.

use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::{Autodiff, tensor::FloatTensor};

use super::{Saved, record};
use crate::backend::ScreenProbeOps;

#[derive(Debug, Clone)]
struct ScreenProbe;

impl<B: ScreenProbeOps> Saved<B, 2> for ScreenProbe {
    fn gradients(self, grad: FloatTensor<B>, _: [bool; 2]) -> [Option<FloatTensor<B>>; 2] {
        [Some(grad.clone()), Some(grad)]
    }
}

impl<B: ScreenProbeOps, C: CheckpointStrategy> ScreenProbeOps for Autodiff<B, C> {
    fn screen_probe(packed: FloatTensor<Self>, probe: FloatTensor<Self>) -> FloatTensor<Self> {
        record::<B, C, ScreenProbe, _, 2>(
            [packed.node(), probe.node()],
            packed.into_primitive(),
            |packed| (packed, ScreenProbe),
            |packed| packed,
        )
    }
}
