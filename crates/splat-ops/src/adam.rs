//! One step of Adam (Kingma & Ba 2015) on one parameter: the arithmetic, without any state.

use burn::backend::Dispatch;
use burn::tensor::Tensor;

use crate::OpError;
use crate::backend::SplatOps;
use crate::check::Checker;

/// The numbers of one step; the bias corrections are already in `rate` and `epsilon`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamStep {
    /// Decay of the first moment.
    pub beta_1: f64,
    /// Decay of the second moment.
    pub beta_2: f64,
    /// Learning rate times `sqrt(1 - beta_2^t) / (1 - beta_1^t)`.
    pub rate: f64,
    /// Added to the root of the second moment; epsilon times `sqrt(1 - beta_2^t)`.
    pub epsilon: f64,
    /// Which rows take the step.
    pub rows: AdamRows,
}

/// Which rows of a parameter, along its first dimension, a step changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum AdamRows {
    /// All, as Adam is defined: where the gradient is zero, moments decay and parameters drift on.
    #[default]
    All,
    /// Those whose gradient is not all zero; the others keep parameter and moments, as if the step had not been for
    /// them (the sparse Adam of Mallick et al. 2024, *Taming 3DGS*; `SelectiveAdam` of gsplat). Another optimiser with
    /// other results, and faster where most Gaussians are out of view.
    Seen,
}

/// Steps a parameter and its two moments, all of one shape:
/// `m = beta_1 m + (1 - beta_1) g`, `v = beta_2 v + (1 - beta_2) g^2`,
/// `p = p - rate m / (sqrt(v) + epsilon)`. Not differentiable. One pass over memory, in place where nothing else
/// holds the tensors.
///
/// A gradient whose square is not finite counts as zero: one NaN would stay in the moments for good.
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
    let stepped = <Dispatch as SplatOps>::adam(
        param.into_dispatch(),
        grad.into_dispatch(),
        moment_1.into_dispatch(),
        moment_2.into_dispatch(),
        *step,
    );
    Ok((
        Tensor::from_dispatch(stepped.param),
        [stepped.moment_1, stepped.moment_2].map(Tensor::from_dispatch),
    ))
}
