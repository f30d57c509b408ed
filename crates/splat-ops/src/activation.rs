//! Activations of scales and opacities (3DGS section 5.1).

use burn::backend::Dispatch;
use burn::tensor::Tensor;
use tracing::trace_span;

use crate::backend::ActivationOps;
use crate::settings::Activation;

/// `exp(x)`, the activation of log-scales.
///
/// Equal to [`Tensor::exp`] within 2 units in the last place on every device. On the CPU it uses
/// SIMD and all threads.
///
/// ```
/// use burn::tensor::{Device, Tensor};
///
/// let x = Tensor::<1>::zeros([1], &Device::flex());
/// assert_eq!(splat_ops::exp(x).into_scalar::<f32>(), 1.0);
/// ```
pub fn exp<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    activate(x, Activation::Exp)
}

/// The logistic function `1 / (1 + exp(-x))`, the activation of opacity logits.
///
/// The gradient is computed from x, as `e / (1 + e)^2` with `e = exp(-|x|)`. Burn's own sigmoid
/// computes it from the output, as `o (1 - o)`, which is exactly zero once o rounds to one (in
/// single precision from a logit of 17): a saturated Gaussian could never become transparent again.
///
/// ```
/// use burn::tensor::{Device, Tensor};
///
/// let x = Tensor::<1>::zeros([1], &Device::flex());
/// assert_eq!(splat_ops::sigmoid(x).into_scalar::<f32>(), 0.5);
/// ```
pub fn sigmoid<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    activate(x, Activation::Sigmoid)
}

fn activate<const D: usize>(x: Tensor<D>, function: Activation) -> Tensor<D> {
    let _span = trace_span!("activations").entered();
    Tensor::from_dispatch(Dispatch::activation(x.into_dispatch(), function))
}
