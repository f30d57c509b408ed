//! One step of Adam (Kingma & Ba 2015) on one parameter, in one pass.
//!
//! ```text
//! m = beta_1 m + (1 - beta_1) g,   v = beta_2 v + (1 - beta_2) g²,   p = p - rate m / (√v + epsilon)
//! ```
//! A gradient whose square is not finite counts as zero.
//!
//! Floor per value: 16 bytes read, 12 written, about 12 operations: bound by memory.

use cubecl::prelude::*;

use crate::floor::{Bytes, Sizes};
use crate::launch::{Buffer, per_element};

/// The numbers of one step; the bias corrections are in `rate` and `epsilon`.
#[derive(Clone, Copy, Debug)]
pub struct AdamStep {
    /// Decay of the first moment.
    pub beta_1: f64,
    /// Decay of the second moment.
    pub beta_2: f64,
    /// Learning rate times `sqrt(1 - beta_2^t) / (1 - beta_1^t)`.
    pub rate: f64,
    /// Added to the root of the second moment; epsilon times `sqrt(1 - beta_2^t)`.
    pub epsilon: f64,
}

/// Weights of the old moments and of what is new, in this order; rate; epsilon.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Numbers {
    keep_1: f32,
    take_1: f32,
    keep_2: f32,
    take_2: f32,
    rate: f32,
    epsilon: f32,
}

#[cube(launch)]
fn adam_values(
    param: &[f32],
    grad: &[f32],
    moment_1: &[f32],
    moment_2: &[f32],
    param_out: &mut [f32],
    moment_1_out: &mut [f32],
    moment_2_out: &mut [f32],
    numbers: Numbers,
    len: u32,
) {
    let i = ABSOLUTE_POS;
    if i < len as usize {
        let g = grad[i];
        let usable = g * g <= f32::MAX;
        let g = select(usable, g, 0.0f32);
        let m = moment_1[i] * numbers.keep_1 + g * numbers.take_1;
        let v = moment_2[i] * numbers.keep_2 + g * g * numbers.take_2;
        param_out[i] = param[i] - m / (f32::sqrt(v) + numbers.epsilon) * numbers.rate;
        moment_1_out[i] = m;
        moment_2_out[i] = v;
    }
}

/// What a step of all parameters must move.
pub(crate) fn floor(sizes: &Sizes) -> Bytes {
    let values = sizes.gaussians * sizes.parameters;
    Bytes {
        read: 16 * values,
        written: 12 * values,
    }
}

/// Parameter, gradient and both moments, all of one length, to parameter and moments after the step.
pub fn adam(client: &Client, tensors: [&Buffer; 4], step: &AdamStep) -> [Buffer; 3] {
    let [param, grad, moment_1, moment_2] = tensors;
    let len = tensors.map(Buffer::len).into_iter().min().unwrap_or(0);
    let out = [(); 3].map(|()| Buffer::empty(client, len));
    if let Some((count, dim)) = per_element(len) {
        adam_values::launch(
            client,
            count,
            dim,
            param.arg(),
            grad.arg(),
            moment_1.arg(),
            moment_2.arg(),
            out[0].arg(),
            out[1].arg(),
            out[2].arg(),
            NumbersLaunch::new(
                step.beta_1 as f32,
                (1.0 - step.beta_1) as f32,
                step.beta_2 as f32,
                (1.0 - step.beta_2) as f32,
                step.rate as f32,
                step.epsilon as f32,
            ),
            len as u32,
        );
    }
    out
}
