//! Spherical harmonics on CubeCL devices.

use burn::backend::TensorMetadata;
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::sh;

use super::{buffer, gradients, prepare, tensor};
use crate::backend::{
    OpInputs, SphericalHarmonicsBackend, SphericalHarmonicsGradients, SphericalHarmonicsInputs,
    SphericalHarmonicsOps, SphericalHarmonicsTensors,
};

impl SphericalHarmonicsOps for CubeBackend {
    fn spherical_harmonics(
        OpInputs(inputs): SphericalHarmonicsInputs<Self>,
        degree: usize,
    ) -> CubeTensor {
        let SphericalHarmonicsTensors { coeffs, dirs } = inputs.map(prepare);
        let colors = sh::evaluate(
            &dirs.client,
            &buffer(&coeffs),
            &buffer(&dirs),
            coeffs.shape()[1],
            degree,
        );
        tensor(&dirs, colors, dirs.shape())
    }
}

impl SphericalHarmonicsBackend for CubeBackend {
    fn spherical_harmonics_backward(
        OpInputs(inputs): SphericalHarmonicsInputs<Self>,
        grad_colors: CubeTensor,
        degree: usize,
        needs_grad: SphericalHarmonicsTensors<bool>,
    ) -> SphericalHarmonicsGradients<Self> {
        let inputs = inputs.map(prepare);
        let SphericalHarmonicsTensors { coeffs, dirs } = &inputs;
        let grads = sh::evaluate_backward(
            &dirs.client,
            &buffer(coeffs),
            &buffer(dirs),
            &buffer(&prepare(grad_colors)),
            coeffs.shape()[1],
            degree,
            needs_grad.into(),
        );
        gradients(grads, inputs.inputs().into()).into()
    }
}
