//! Noise of the means on CubeCL devices.

use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use splat_kernels::perturb::perturb;

use super::{buffer, prepare, taken};
use crate::backend::{OpInputs, PerturbInputs, PerturbOps, PerturbTensors};
use crate::settings::Perturbation;

impl PerturbOps for CubeBackend {
    fn perturb(OpInputs(inputs): PerturbInputs<Self>, noise: Perturbation) -> CubeTensor {
        let PerturbTensors {
            means,
            quats,
            log_scales,
            opacity_logits,
        } = inputs.map(prepare);
        let client = means.client.clone();
        let (means, tensor) = taken(means);
        tensor(perturb(
            &client,
            means,
            &buffer(&quats),
            &buffer(&log_scales),
            &buffer(&opacity_logits),
            &noise,
        ))
    }
}
