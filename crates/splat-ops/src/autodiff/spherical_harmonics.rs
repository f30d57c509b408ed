//! `spherical_harmonics`: saves coefficients and directions.

use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::{Autodiff, tensor::FloatTensor};

use tracing::trace_span;

use super::{Saved, record};
use crate::backend::{
    OpInputs, SphericalHarmonicsBackend, SphericalHarmonicsInputs, SphericalHarmonicsOps,
};

#[derive(Debug, Clone)]
struct SphericalHarmonics<B: SphericalHarmonicsBackend> {
    inputs: SphericalHarmonicsInputs<B>,
    degree: usize,
}

impl<B: SphericalHarmonicsBackend> Saved<B, 2> for SphericalHarmonics<B> {
    fn gradients(self, grad: FloatTensor<B>, needs_grad: [bool; 2]) -> [Option<FloatTensor<B>>; 2] {
        let _span = trace_span!("spherical harmonics gradient").entered();
        B::spherical_harmonics_backward(self.inputs, grad, self.degree, needs_grad.into()).into()
    }
}

impl<B: SphericalHarmonicsBackend, C: CheckpointStrategy> SphericalHarmonicsOps for Autodiff<B, C> {
    fn spherical_harmonics(
        OpInputs(inputs): SphericalHarmonicsInputs<Self>,
        degree: usize,
    ) -> FloatTensor<Self> {
        record::<B, C, SphericalHarmonics<B>, _, 2>(
            <[_; 2]>::from(inputs.clone()).map(|input| input.node()),
            OpInputs(inputs.map(|input| input.into_primitive())),
            |inputs| {
                let colors = B::spherical_harmonics(inputs.clone(), degree);
                (colors, SphericalHarmonics { inputs, degree })
            },
            |inputs| B::spherical_harmonics(inputs, degree),
        )
    }
}
