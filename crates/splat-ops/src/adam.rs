//! One step of Adam (Kingma & Ba 2015) on one parameter, without state.

use burn::backend::Dispatch;
use burn::tensor::Tensor;
use tracing::trace_span;

use crate::OpError;
use crate::backend::{AdamOps, AdamTensors, OpInputs};
use crate::check::Checker;
use crate::settings::AdamStep;

/// Steps a parameter and its two moments, all of one shape.
///
/// `m = beta_1 m + (1 - beta_1) g`, `v = beta_2 v + (1 - beta_2) g^2`, `p = p - rate m / (sqrt(v) +
/// epsilon)`. Takes one pass over memory, in place if nothing else holds the tensors. Not
/// differentiable.
///
/// A gradient whose square is not finite counts as zero; a NaN would stay in the moments forever.
///
/// ```
/// use burn::tensor::{Device, Tensor};
/// use splat_ops::{AdamRows, AdamStep, adam_step};
///
/// let ones = Tensor::<1>::ones([2], &Device::flex());
/// let moments = [ones.zeros_like(), ones.zeros_like()];
/// // The first step of a rate of 0.1, with the bias corrections in it.
/// let (beta_1, beta_2) = (0.9, 0.999f64);
/// let correction = (1.0 - beta_2).sqrt();
/// let step = AdamStep {
///     beta_1,
///     beta_2,
///     rate: 0.1 * correction / (1.0 - beta_1),
///     epsilon: 1e-15 * correction,
///     rows: AdamRows::All,
/// };
/// let (stepped, _) = adam_step(ones.clone(), ones, moments, &step)?;
/// let stepped: Vec<f32> = stepped.into_data().try_into_vec().unwrap();
/// assert!((stepped[0] - 0.9).abs() < 1e-6);
/// # Ok::<(), splat_ops::OpError>(())
/// ```
///
/// # Errors
/// When shapes, types or devices differ.
pub fn adam_step<const D: usize>(
    param: Tensor<D>,
    grad: Tensor<D>,
    moments: [Tensor<D>; 2],
    step: &AdamStep,
) -> Result<(Tensor<D>, [Tensor<D>; 2]), OpError> {
    let [moment_1, moment_2] = moments;
    let check = Checker::new("adam_step", "param", &param)?;
    for (name, other) in [
        ("grad", &grad),
        ("moment_1", &moment_1),
        ("moment_2", &moment_2),
    ] {
        check.tensor(name, other, param.dims().map(Some), "that of `param`")?;
    }
    let inputs = OpInputs(AdamTensors {
        param: param.into_dispatch(),
        grad: grad.into_dispatch(),
        moment_1: moment_1.into_dispatch(),
        moment_2: moment_2.into_dispatch(),
    });
    let _span = trace_span!("adam").entered();
    let stepped = Dispatch::adam(inputs, *step);
    Ok((
        Tensor::from_dispatch(stepped.param),
        [stepped.moment_1, stepped.moment_2].map(Tensor::from_dispatch),
    ))
}
