//! One step of Adam (Kingma & Ba 2015) on one parameter, without state.

use burn::backend::Dispatch;
use burn::tensor::Tensor;
use tracing::trace_span;

use crate::OpError;
use crate::backend::{AdamOps, AdamOutputs, AdamTensors, OpInputs};
use crate::check::Checker;
use crate::settings::{AdamGap, AdamStep, RowGroups};

/// A parameter and its two moments.
type Stepped<const D: usize> = (Tensor<D>, [Tensor<D>; 2]);

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
) -> Result<Stepped<D>, OpError> {
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
    Ok(tensors(Dispatch::adam(inputs, *step)))
}

/// [`adam_step`] of some rows of a parameter `[N, ...]` and its moments, given the gradient `[N',
/// ...]` of these rows alone. The other rows stay as they are, and the step takes no time for them
/// where nothing else holds the tensors.
///
/// ```
/// use burn::tensor::{Device, Tensor};
/// use splat_ops::{AdamRows, AdamStep, RowGroups, adam_step_groups};
///
/// let param = Tensor::<1>::ones([5], &Device::flex());
/// let moments = [param.zeros_like(), param.zeros_like()];
/// let rows = RowGroups::new(2, 5, vec![0, 2]).unwrap(); // Rows 0, 1 and 4.
/// let gradient = Tensor::<1>::ones([3], &Device::flex());
/// let step = AdamStep { beta_1: 0.0, beta_2: 0.0, rate: 0.5, epsilon: 0.0, rows: AdamRows::All };
/// let (stepped, _) = adam_step_groups(param, gradient, moments, &rows, &step)?;
/// let stepped: Vec<f32> = stepped.into_data().try_into_vec().unwrap();
/// assert_eq!(stepped, [0.5, 0.5, 1.0, 1.0, 0.5]);
/// # Ok::<(), splat_ops::OpError>(())
/// ```
///
/// # Errors
/// When shapes, types or devices differ, or the rows are those of a tensor of another length.
pub fn adam_step_groups<const D: usize>(
    param: Tensor<D>,
    grad: Tensor<D>,
    moments: [Tensor<D>; 2],
    rows: &RowGroups,
    step: &AdamStep,
) -> Result<Stepped<D>, OpError> {
    let [moment_1, moment_2] = moments;
    let check = Checker::new("adam_step_groups", "param", &param)?;
    check_rows(&check, &param, [&moment_1, &moment_2], rows)?;
    let mut shape = param.dims().map(Some);
    shape[0] = Some(rows.len());
    check.tensor(
        "grad",
        &grad,
        shape,
        "that of `param` with a row for each of `rows`",
    )?;
    let inputs = OpInputs(AdamTensors {
        param: param.into_dispatch(),
        grad: grad.into_dispatch(),
        moment_1: moment_1.into_dispatch(),
        moment_2: moment_2.into_dispatch(),
    });
    let _span = trace_span!("adam").entered();
    Ok(tensors(Dispatch::adam_groups(inputs, *step, rows.clone())))
}

/// Does to some rows of a parameter `[N, ...]` and its moments what steps of Adam without a
/// gradient would have done, all at once; `gaps` says for each group which steps. In place where
/// nothing else holds the tensors. Not differentiable.
///
/// ```
/// use burn::tensor::{Device, Tensor};
/// use splat_ops::{AdamGap, RowGroups, adam_catch_up};
///
/// let tensor = |value: f32| Tensor::<1>::full([3], value, &Device::flex());
/// let rows = RowGroups::new(1, 3, vec![1]).unwrap();
/// // Two steps of a rate of 1, which halve the first moment.
/// let gap = AdamGap { keep_1: 0.25, keep_2: 1.0, step: 0.5 + 0.25, epsilon: 0.0 };
/// let moments = [tensor(2.0), tensor(1.0)];
/// let (param, [moment_1, _]) = adam_catch_up(tensor(3.0), moments, &rows, &[gap])?;
/// let values = |tensor: Tensor<1>| tensor.into_data().try_into_vec::<f32>().unwrap();
/// assert_eq!(values(param), [3.0, 1.5, 3.0]);
/// assert_eq!(values(moment_1), [2.0, 0.5, 2.0]);
/// # Ok::<(), splat_ops::OpError>(())
/// ```
///
/// # Errors
/// When shapes, types or devices differ, or there is not one gap for each group.
pub fn adam_catch_up<const D: usize>(
    param: Tensor<D>,
    moments: [Tensor<D>; 2],
    rows: &RowGroups,
    gaps: &[AdamGap],
) -> Result<Stepped<D>, OpError> {
    let [moment_1, moment_2] = moments;
    let check = Checker::new("adam_catch_up", "param", &param)?;
    check_rows(&check, &param, [&moment_1, &moment_2], rows)?;
    if gaps.len() != rows.chosen().len() {
        let (gaps, groups) = (gaps.len(), rows.chosen().len());
        return Err(check.argument(format!("{gaps} gaps for {groups} groups of rows")));
    }
    let inputs = AdamOutputs {
        param: param.into_dispatch(),
        moment_1: moment_1.into_dispatch(),
        moment_2: moment_2.into_dispatch(),
    };
    let _span = trace_span!("adam catch-up").entered();
    Ok(tensors(Dispatch::adam_catch_up(
        inputs,
        rows.clone(),
        gaps.to_vec(),
    )))
}

fn check_rows<const D: usize>(
    check: &Checker,
    param: &Tensor<D>,
    moments: [&Tensor<D>; 2],
    rows: &RowGroups,
) -> Result<(), OpError> {
    let shape = param.dims();
    for (name, moment) in ["moment_1", "moment_2"].into_iter().zip(moments) {
        check.tensor(name, moment, shape.map(Some), "that of `param`")?;
    }
    let (expected, found) = (shape[0], rows.count());
    if expected != found {
        return Err(check.argument(format!(
            "`rows` are those of a tensor of {found} rows, `param` has {expected}"
        )));
    }
    Ok(())
}

fn tensors<const D: usize>(stepped: AdamOutputs<Dispatch>) -> Stepped<D> {
    (
        Tensor::from_dispatch(stepped.param),
        [stepped.moment_1, stepped.moment_2].map(Tensor::from_dispatch),
    )
}
