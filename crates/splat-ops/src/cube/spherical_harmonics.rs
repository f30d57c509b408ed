//! Spherical harmonics on CubeCL devices.

use burn::backend::TensorMetadata;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::sh;

use super::{buffer, prepare, tensor};

/// Colours `[C, N, 3]`.
pub(super) fn forward(coeffs: CubeTensor, dirs: CubeTensor, degree: usize) -> CubeTensor {
    let (coeffs, dirs) = (prepare(coeffs), prepare(dirs));
    let stored = coeffs.shape()[1];
    let colors = sh::evaluate(
        &dirs.client,
        &buffer(&coeffs),
        &buffer(&dirs),
        stored,
        degree,
    );
    tensor(&dirs, colors, dirs.shape())
}

/// The wanted gradients of coefficients and directions.
pub(super) fn backward(
    coeffs: CubeTensor,
    dirs: CubeTensor,
    grad: CubeTensor,
    degree: usize,
    wanted: [bool; 2],
) -> [Option<CubeTensor>; 2] {
    let (coeffs, dirs, grad) = (prepare(coeffs), prepare(dirs), prepare(grad));
    let stored = coeffs.shape()[1];
    let [grad_coeffs, grad_dirs] = sh::evaluate_backward(
        &dirs.client,
        &buffer(&coeffs),
        &buffer(&dirs),
        &buffer(&grad),
        stored,
        degree,
        wanted,
    );
    [
        grad_coeffs.map(|grad| tensor(&coeffs, grad, coeffs.shape())),
        grad_dirs.map(|grad| tensor(&dirs, grad, dirs.shape())),
    ]
}
