//! Noise of the means in one pass, in place.

use core::marker::PhantomData;

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use rayon::prelude::*;
use splat_core::noise::{NEGLIGIBLE_NOISE, normals, pcg4d};

use super::buffer::{Buffer, BufferMut};
use super::math::{apply, apply_transposed, normalize_quat, rotation};
use super::real::Real;
use crate::backend::{OpInputs, PerturbInputs, PerturbOps, PerturbTensors};
use crate::settings::Perturbation;

/// Gaussians per unit of parallel work, at least.
const CHUNK: usize = 1024;

impl PerturbOps for Flex {
    fn perturb(OpInputs(inputs): PerturbInputs<Self>, noise: Perturbation) -> FlexTensor {
        in_precision!(inputs.means, perturb, inputs, &noise)
    }
}

fn perturb<T: Real>(
    _: PhantomData<T>,
    inputs: PerturbTensors<FlexTensor>,
    noise: &Perturbation,
) -> FlexTensor {
    let mut means = BufferMut::new(inputs.means);
    let [quats, log_scales, opacity_logits] =
        [inputs.quats, inputs.log_scales, inputs.opacity_logits].map(Buffer::new);
    let rows = means.slice::<T>().as_chunks_mut::<3>().0.par_iter_mut();
    rows.zip(quats.slice::<T>().as_chunks::<4>().0)
        .zip(log_scales.slice::<T>().as_chunks::<3>().0)
        .zip(opacity_logits.slice::<T>())
        .enumerate()
        .with_min_len(CHUNK)
        .for_each(|(row, (((mean, quat), log_scale), logit))| {
            let gaussian = (quat.map(T::wide), log_scale.map(T::wide), logit.wide());
            let Some(offset) =
                displacement(gaussian, noise, || normals(pcg4d(noise.words(row as u32))))
            else {
                return;
            };
            // Finite in this precision too.
            let offset = offset.map(T::of);
            if offset.iter().all(|value| value.is_finite()) {
                for (mean, offset) in mean.iter_mut().zip(offset) {
                    *mean += offset;
                }
            }
        });
    means.into_tensor()
}

/// `gate Sigma eps` of one Gaussian, given quaternion, logarithms of the scales, and the logit of
/// its opacity; nothing where it stays. The draws are made only where they are needed.
fn displacement(
    (quat, log_scales, logit): ([f64; 4], [f64; 3], f64),
    noise: &Perturbation,
    draws: impl FnOnce() -> [f64; 3],
) -> Option<[f64; 3]> {
    let opacity = 1.0 / (1.0 + (-logit).exp());
    let gate = noise.gate(opacity);
    let scales = log_scales.map(f64::exp);
    let largest = scales.into_iter().fold(0.0, f64::max);
    if !(gate * largest > NEGLIGIBLE_NOISE) {
        return None;
    }
    let (unit, _, has_length) = normalize_quat(quat);
    let axes = rotation(unit);
    let along = apply_transposed(&axes, draws());
    let along = [0, 1, 2].map(|axis| gate * scales[axis] * scales[axis] * along[axis]);
    let offset = apply(&axes, along);
    has_length.then_some(offset)
}
