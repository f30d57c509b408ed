//! `photometric`: saves both images and the intermediate results of the backend.

use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::{Autodiff, tensor::FloatTensor};

use tracing::trace_span;

use super::{Saved, record};
use crate::backend::{PhotometricBackend, PhotometricOps, Target};
use crate::settings::SsimArgs;

#[derive(Debug, Clone)]
struct Photometric<B: PhotometricBackend> {
    rendered: FloatTensor<B>,
    target: Target<B>,
    kept: FloatTensor<B>,
    args: SsimArgs,
}

impl<B: PhotometricBackend> Saved<B, 1> for Photometric<B> {
    fn gradients(self, grad: FloatTensor<B>, _: [bool; 1]) -> [Option<FloatTensor<B>>; 1] {
        let _span = trace_span!("photometric gradient").entered();
        let Self {
            rendered,
            target,
            kept,
            args,
        } = self;
        [Some(B::photometric_backward(
            rendered, target, kept, grad, &args,
        ))]
    }
}

impl<B: PhotometricBackend, C: CheckpointStrategy> PhotometricOps for Autodiff<B, C> {
    fn photometric(
        rendered: FloatTensor<Self>,
        target: Target<Self>,
        args: SsimArgs,
    ) -> FloatTensor<Self> {
        let target = match target {
            Target::Levels(levels) => Target::Levels(levels),
            Target::Values(values) => Target::Values(values.into_primitive()),
        };
        record::<B, C, Photometric<B>, _, 1>(
            [rendered.node()],
            (rendered.into_primitive(), target, args),
            |(rendered, target, args)| {
                let (losses, kept) =
                    B::photometric_tracked(rendered.clone(), target.clone(), &args);
                (
                    losses,
                    Photometric {
                        rendered,
                        target,
                        kept,
                        args,
                    },
                )
            },
            |(rendered, target, args)| B::photometric(rendered, target, args),
        )
    }
}
