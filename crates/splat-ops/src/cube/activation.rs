//! Activations on CubeCL devices.

use burn_cubecl::tensor::CubeTensor;
use splat_kernels::activation as kernels;

use super::{buffer, prepare, taken};
use crate::settings::Activation;

/// The function of every element.
pub(super) fn forward(x: CubeTensor, function: Activation) -> CubeTensor {
    let client = x.client.clone();
    let (x, tensor) = taken(prepare(x));
    tensor(kernels::activate(&client, x, function))
}

/// The gradient of `x`.
pub(super) fn backward(
    [x, y]: [CubeTensor; 2],
    grad: CubeTensor,
    function: Activation,
) -> CubeTensor {
    let [x, y] = [x, y].map(prepare);
    let (grad, tensor) = taken(prepare(grad));
    let known = [&buffer(&x), &buffer(&y)];
    tensor(kernels::activate_vjp(&x.client, known, grad, function))
}
