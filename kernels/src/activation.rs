//! Activations of scales and opacities, elementwise, and their gradients (3DGS section 5.1).
//!
//! ```text
//! exp(x)                           gradient g exp(x)
//! sigmoid(x) = 1 / (1 + exp(-x))   gradient g e / (1 + e)²,  e = exp(-|x|)
//! ```
//! The gradient of the logistic function is computed from its argument: computed from its value, `y
//! (1 - y)` would be zero once y rounds to 1.
//!
//! Floor per element: 4 bytes read, 4 written, about 18 operations. Gradients: 8 bytes read, 4
//! written, and 1 (exp) or about 20 (sigmoid) operations.

use cubecl::prelude::*;
use splat_core::Activation;

use crate::bytes::{Bytes, Sizes};
use crate::exp::exp;
use crate::launch::{Buffer, per_element};

/// Floors of the three scales and the opacity of each Gaussian, and of their gradients.
pub(crate) fn floor(sizes: &Sizes) -> [Bytes; 2] {
    let values = 4 * sizes.gaussians;
    [
        Bytes {
            read: 4 * values,
            written: 4 * values,
        },
        Bytes {
            read: 8 * values,
            written: 4 * values,
        },
    ]
}

#[cube(launch)]
fn activate_each(x: &[f32], y: &mut [f32], len: u32, #[comptime] function: Activation) {
    let i = ABSOLUTE_POS;
    if i < len as usize {
        if comptime!(function == Activation::Exp) {
            y[i] = exp(x[i]);
        } else {
            // exp(min(x, 0)) / (1 + exp(-|x|)): one of the two exponentials is 1.
            let small = exp(-f32::abs(x[i]));
            let above = select(x[i] < 0.0f32, small, 1.0f32);
            y[i] = above / (1.0f32 + small);
        }
    }
}

/// Applies the function to every element, in the memory of `x` if nothing else holds it.
pub fn activate(client: &Client, x: Buffer, function: Activation) -> Buffer {
    let len = x.len();
    let (y, [input, output]) = x.overwritten(client, 0);
    if let Some((count, dim)) = per_element(len) {
        activate_each::launch(client, count, dim, input, output, len as u32, function);
    }
    y
}

/// `known`: the output of the exponential, or the input of the logistic function.
#[cube(launch)]
fn activate_each_vjp(
    known: &[f32],
    grad: &[f32],
    out: &mut [f32],
    len: u32,
    #[comptime] function: Activation,
) {
    let i = ABSOLUTE_POS;
    if i < len as usize {
        if comptime!(function == Activation::Exp) {
            out[i] = grad[i] * known[i];
        } else {
            let small = exp(-f32::abs(known[i]));
            let one = 1.0f32 + small;
            out[i] = grad[i] * (small / one / one);
        }
    }
}

/// Gradient of the argument `x` of [`activate`], from its value `y` and the gradient of the value,
/// in whose memory it is written if nothing else holds it.
pub fn activate_vjp(
    client: &Client,
    [x, y]: [&Buffer; 2],
    grad: Buffer,
    function: Activation,
) -> Buffer {
    let known = match function {
        Activation::Exp => y,
        Activation::Sigmoid => x,
    };
    let len = grad.len().min(known.len());
    let (out, [input, output]) = grad.overwritten(client, 1);
    if let Some((count, dim)) = per_element(len) {
        activate_each_vjp::launch(
            client,
            count,
            dim,
            known.arg(),
            input,
            output,
            len as u32,
            function,
        );
    }
    out
}
