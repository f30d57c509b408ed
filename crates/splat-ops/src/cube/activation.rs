//! Activations on CubeCL devices.

use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::activation as kernels;

use super::{buffer, prepare, taken};
use crate::backend::{ActivationBackend, ActivationOps};
use crate::composed;
use crate::settings::Activation;

impl ActivationOps for CubeBackend {
    fn activation(x: CubeTensor, function: Activation) -> CubeTensor {
        if x.dtype != DType::F32 {
            return composed::activation::<Self>(x, function);
        }
        let client = x.client.clone();
        let (x, tensor) = taken(prepare(x));
        tensor(kernels::activate(&client, x, function))
    }
}

impl ActivationBackend for CubeBackend {
    fn activation_backward(
        x: CubeTensor,
        y: CubeTensor,
        grad_y: CubeTensor,
        function: Activation,
    ) -> CubeTensor {
        if x.dtype != DType::F32 {
            return composed::activation_backward::<Self>(x, y, grad_y, function);
        }
        let [x, y] = [x, y].map(prepare);
        let (grad, tensor) = taken(prepare(grad_y));
        let known = [&buffer(&x), &buffer(&y)];
        tensor(kernels::activate_vjp(&x.client, known, grad, function))
    }
}
