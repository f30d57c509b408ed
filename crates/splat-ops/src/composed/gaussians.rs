//! What belongs to the Gaussians: activations, statistics, rows.

use burn::backend::{Backend, TensorMetadata, get_or_init_device_settings, tensor::FloatTensor};
use burn::tensor::{Shape, Slice};

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

/// Sums of screen gradients and of views, with those of one step added.
pub(crate) fn screen_statistics<B: Backend>(
    [gradient, extents, gradients, views]: [FloatTensor<B>; 4],
    half: [f64; 2],
) -> [FloatTensor<B>; 2] {
    let shape = gradient.shape();
    let (c, n) = (shape[0], shape[1]);
    if n == 0 {
        return [gradients, views];
    }
    let bools = bools::<B>(&gradient);
    let floats = gradient.dtype();
    let column = |tensor: &FloatTensor<B>, i: usize| {
        let part = [0..c, 0..n, i..i + 1].map(Slice::from);
        B::float_reshape(B::float_slice(tensor.clone(), &part), Shape::from([c, n]))
    };
    let square = |i: usize| {
        let side = B::float_mul_scalar(column(&gradient, i), half[i].into());
        B::float_mul(side.clone(), side)
    };
    let seen = B::float_greater_elem(column(&extents, 0), 0.0.into(), bools);
    let length = B::float_sqrt(B::float_add(square(0), square(1)));
    // What is not finite must not hide the other views of the same Gaussian. Written so that NaN fails the comparison.
    let finite = B::float_lower_equal_elem(length.clone(), f32::MAX.into(), bools);
    let counts = B::bool_and(seen.clone(), finite);
    let length = B::float_mask_fill(length, B::bool_not(counts), 0.0.into());
    let seen = B::bool_into_float(seen, floats.into());
    let sum = |of: FloatTensor<B>| B::float_reshape(B::float_sum_dim(of, 0), Shape::from([n]));
    [
        B::float_add(gradients, sum(length)),
        B::float_add(views, sum(seen)),
    ]
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
    let bools = bools::<B>(&grad);
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

/// The type of masks on the device of a tensor.
fn bools<B: Backend>(tensor: &FloatTensor<B>) -> burn::tensor::BoolDType {
    get_or_init_device_settings::<B>(&tensor.device()).bool_dtype
}
