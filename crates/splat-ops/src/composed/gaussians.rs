//! What belongs to the Gaussians: activations, rows.

use burn::backend::{Backend, tensor::FloatTensor};
#[cfg(feature = "cube")]
use burn::backend::{TensorMetadata, get_or_init_device_settings};
#[cfg(feature = "cube")]
use burn::tensor::Shape;

use crate::activation::Activation;

/// The function of every element.
pub(crate) fn activate<B: Backend>(x: FloatTensor<B>, function: Activation) -> FloatTensor<B> {
    match function {
        Activation::Exp => B::float_exp(x),
        // exp(min(x, 0)) / (1 + exp(-|x|)): neither exponent is positive.
        Activation::Sigmoid => {
            let above = B::float_exp(B::float_clamp_max(x.clone(), 0.0.into()));
            B::float_div(above, one_and_small::<B>(x).1)
        }
    }
}

/// `e = exp(-|x|)` and `1 + e`.
fn one_and_small<B: Backend>(x: FloatTensor<B>) -> (FloatTensor<B>, FloatTensor<B>) {
    let small = B::float_exp(B::float_neg(B::float_abs(x)));
    (small.clone(), B::float_add_scalar(small, 1.0.into()))
}

/// `grad y'`; of the logistic function `y' = e / (1 + e)^2`, which keeps its digits at both ends.
pub(crate) fn activate_backward<B: Backend>(
    x: FloatTensor<B>,
    y: FloatTensor<B>,
    grad: FloatTensor<B>,
    function: Activation,
) -> FloatTensor<B> {
    match function {
        Activation::Exp => B::float_mul(grad, y),
        Activation::Sigmoid => {
            let (small, one) = one_and_small::<B>(x);
            let slope = B::float_div(B::float_div(small, one.clone()), one);
            B::float_mul(grad, slope)
        }
    }
}

/// `after` in the rows whose gradient is not all zero, `before` in the others.
#[cfg(feature = "cube")]
pub(crate) fn where_seen<B: Backend>(
    grad: FloatTensor<B>,
    before: [FloatTensor<B>; 3],
    after: [FloatTensor<B>; 3],
) -> [FloatTensor<B>; 3] {
    let shape = grad.shape();
    let (rows, elements) = (shape[0], shape.num_elements());
    if elements == 0 {
        return after;
    }
    let table = Shape::from([rows, elements / rows]);
    let bools = get_or_init_device_settings::<B>(&grad.device()).bool_dtype;
    let floats = grad.dtype();
    let any = B::float_greater_elem(B::float_abs(grad), 0.0.into(), bools);
    let count = B::bool_into_float(B::bool_reshape(any, table.clone()), floats.into());
    let unseen = B::float_lower_elem(B::float_sum_dim(count, 1), 0.5.into(), bools);
    let unseen = B::bool_reshape(B::bool_expand(unseen, table), shape);
    let mut before = before.into_iter();
    after.map(|after| match before.next() {
        Some(before) => B::float_mask_where(after, unseen.clone(), before),
        None => after,
    })
}
