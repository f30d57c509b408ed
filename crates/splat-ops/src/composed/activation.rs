//! `exp` and the logistic function.

use burn::backend::{Backend, tensor::FloatTensor};

use crate::settings::Activation;

/// Applies the function to every element.
pub(crate) fn activation<B: Backend>(x: FloatTensor<B>, function: Activation) -> FloatTensor<B> {
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

/// `grad y'`; for the logistic function `y' = e / (1 + e)^2`, which is accurate at both ends.
pub(crate) fn activation_backward<B: Backend>(
    x: FloatTensor<B>,
    y: FloatTensor<B>,
    grad_y: FloatTensor<B>,
    function: Activation,
) -> FloatTensor<B> {
    match function {
        Activation::Exp => B::float_mul(grad_y, y),
        Activation::Sigmoid => {
            let (small, one) = one_and_small::<B>(x);
            let slope = B::float_div(B::float_div(small, one.clone()), one);
            B::float_mul(grad_y, slope)
        }
    }
}
