//! Adam in one pass over memory.

use core::marker::PhantomData;

use burn::backend::TensorMetadata;
use burn::backend::flex::FlexTensor;
use burn::tensor::TensorData;
use rayon::prelude::*;

use super::buffer::{Buffer, overwritten};
use super::real::Real;
use crate::adam::AdamStep;

/// Elements per unit of parallel work.
const CHUNK: usize = 8192;

pub(super) fn step<T: Real>(
    _: PhantomData<T>,
    [param, grad, moment_1, moment_2]: [FlexTensor; 4],
    step: &AdamStep,
) -> [FlexTensor; 3] {
    let shape = param.shape();
    let buffers = [param, grad, moment_1, moment_2].map(Buffer::new);
    let [param, grad, moment_1, moment_2] = buffers.each_ref().map(|b| b.slice::<T>());
    let (beta_1, beta_2) = (T::of(step.beta_1), T::of(step.beta_2));
    let (rest_1, rest_2) = (T::of(1.0 - step.beta_1), T::of(1.0 - step.beta_2));
    let (rate, epsilon) = (T::of(step.rate), T::of(step.epsilon));

    let mut out = [(); 3].map(|()| overwritten::<T>(param.len()));
    let [out_param, out_1, out_2] = &mut out;
    out_param
        .par_chunks_mut(CHUNK)
        .zip(out_1.par_chunks_mut(CHUNK))
        .zip(out_2.par_chunks_mut(CHUNK))
        .enumerate()
        .for_each(|(chunk, ((out_param, out_1), out_2))| {
            let range = chunk * CHUNK..chunk * CHUNK + out_param.len();
            let (param, grad) = (&param[range.clone()], &grad[range.clone()]);
            let (moment_1, moment_2) = (&moment_1[range.clone()], &moment_2[range]);
            for i in 0..out_param.len() {
                let usable = (grad[i] * grad[i]).is_finite();
                let g = if usable { grad[i] } else { T::ZERO };
                let m = moment_1[i] * beta_1 + g * rest_1;
                let v = moment_2[i] * beta_2 + g * g * rest_2;
                out_1[i] = m;
                out_2[i] = v;
                out_param[i] = param[i] - m / (v.sqrt() + epsilon) * rate;
            }
        });
    out.map(|values| FlexTensor::from_data(TensorData::new(values, shape.clone())))
}
