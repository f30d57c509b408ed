//! Adam in one pass over memory, in place.

use core::marker::PhantomData;

use burn::backend::flex::FlexTensor;
use burn::backend::{Flex, TensorMetadata};
use rayon::prelude::*;

use super::buffer::{Buffer, BufferMut};
use super::real::Real;
use super::row_groups::chosen;
use super::simd::vectorized;
use crate::backend::{AdamInputs, AdamOps, AdamOutputs, AdamTensors, OpInputs};
use crate::settings::{AdamGap, AdamRows, AdamStep, RowGroups};

/// Approximate number of elements per unit of parallel work.
const CHUNK: usize = 8192;

/// Constants of a step, in the precision of the tensors.
struct Numbers<T> {
    beta_1: T,
    beta_2: T,
    rest_1: T,
    rest_2: T,
    rate: T,
    epsilon: T,
}

impl<T: Real> Numbers<T> {
    fn of(step: &AdamStep) -> Self {
        Self {
            beta_1: T::of(step.beta_1),
            beta_2: T::of(step.beta_2),
            rest_1: T::of(1.0 - step.beta_1),
            rest_2: T::of(1.0 - step.beta_2),
            rate: T::of(step.rate),
            epsilon: T::of(step.epsilon),
        }
    }
}

impl AdamOps for Flex {
    fn adam(OpInputs(inputs): AdamInputs<Self>, step: AdamStep) -> AdamOutputs<Self> {
        in_precision!(inputs.param, self::step, inputs, &step)
    }

    fn adam_groups(
        OpInputs(inputs): AdamInputs<Self>,
        step: AdamStep,
        rows: RowGroups,
    ) -> AdamOutputs<Self> {
        in_precision!(inputs.param, step_groups, inputs, &step, &rows)
    }

    fn adam_catch_up(
        tensors: AdamOutputs<Self>,
        rows: RowGroups,
        gaps: Vec<AdamGap>,
    ) -> AdamOutputs<Self> {
        in_precision!(tensors.param, catch_up, tensors, &rows, &gaps)
    }
}

/// Values of a row.
fn width(param: &FlexTensor) -> usize {
    let rows = param.shape()[0].max(1);
    (param.shape().num_elements() / rows).max(1)
}

/// Writes parameter and moments into their own memory, unless something else holds that memory too.
fn step<T: Real>(
    _: PhantomData<T>,
    inputs: AdamTensors<FlexTensor>,
    step: &AdamStep,
) -> AdamOutputs<Flex> {
    let AdamTensors {
        param,
        grad,
        moment_1,
        moment_2,
    } = inputs;
    let numbers = Numbers::of(step);
    let width = width(&param);
    let chunk = CHUNK.next_multiple_of(width);

    let grad = Buffer::new(grad);
    let mut stepped = [param, moment_1, moment_2].map(BufferMut::new);
    let [param, moment_1, moment_2] = stepped.each_mut().map(|buffer| buffer.slice::<T>());
    param
        .par_chunks_mut(chunk)
        .zip(moment_1.par_chunks_mut(chunk))
        .zip(moment_2.par_chunks_mut(chunk))
        .zip(grad.slice::<T>().par_chunks(chunk))
        .for_each(|(((param, moment_1), moment_2), grad)| {
            rows(
                step.rows,
                width,
                [param, moment_1, moment_2],
                grad,
                &numbers,
            );
        });
    outputs(stepped)
}

/// Steps whole rows: all, or those with a gradient.
fn rows<T: Real>(
    rows: AdamRows,
    width: usize,
    [param, moment_1, moment_2]: [&mut [T]; 3],
    grad: &[T],
    numbers: &Numbers<T>,
) {
    if rows == AdamRows::All {
        return update(param, moment_1, moment_2, grad, numbers);
    }
    let rows = param
        .chunks_exact_mut(width)
        .zip(moment_1.chunks_exact_mut(width))
        .zip(moment_2.chunks_exact_mut(width))
        .zip(grad.chunks_exact(width));
    for (((param, moment_1), moment_2), grad) in rows {
        // NaN counts as zero.
        if grad.iter().any(|g| g.abs() > T::ZERO) {
            update(param, moment_1, moment_2, grad, numbers);
        }
    }
}

/// Parameter and moments of one group of rows.
type Group<'a, T> = [&'a mut [T]; 3];

/// The chosen groups of rows, in order.
fn groups<'a, T: Real>(
    buffers: &'a mut [BufferMut; 3],
    width: usize,
    rows: &RowGroups,
) -> Vec<Group<'a, T>> {
    let size = rows.size() * width;
    let [param, moment_1, moment_2] = buffers.each_mut().map(|buffer| buffer.slice::<T>());
    let groups = param
        .chunks_mut(size)
        .zip(moment_1.chunks_mut(size))
        .zip(moment_2.chunks_mut(size));
    chosen(
        rows,
        groups.map(|((param, moment_1), moment_2)| [param, moment_1, moment_2]),
    )
}

fn step_groups<T: Real>(
    _: PhantomData<T>,
    inputs: AdamTensors<FlexTensor>,
    step: &AdamStep,
    rows: &RowGroups,
) -> AdamOutputs<Flex> {
    let numbers = Numbers::of(step);
    let width = width(&inputs.param);
    let grad = Buffer::new(inputs.grad);
    let mut stepped = [inputs.param, inputs.moment_1, inputs.moment_2].map(BufferMut::new);
    let grads = grad.slice::<T>().par_chunks(rows.size() * width);
    groups::<T>(&mut stepped, width, rows)
        .into_par_iter()
        .zip(grads)
        .for_each(|(group, grad)| self::rows(step.rows, width, group, grad, &numbers));
    outputs(stepped)
}

fn catch_up<T: Real>(
    _: PhantomData<T>,
    tensors: AdamOutputs<Flex>,
    rows: &RowGroups,
    gaps: &[AdamGap],
) -> AdamOutputs<Flex> {
    let width = width(&tensors.param);
    let mut caught = [tensors.param, tensors.moment_1, tensors.moment_2].map(BufferMut::new);
    groups::<T>(&mut caught, width, rows)
        .into_par_iter()
        .zip(gaps)
        .filter(|(_, gap)| **gap != AdamGap::NONE)
        .for_each(|([param, moment_1, moment_2], gap)| {
            let gap = Gap {
                keep_1: T::of(gap.keep_1),
                keep_2: T::of(gap.keep_2),
                step: T::of(gap.step),
                epsilon: T::of(gap.epsilon),
            };
            drift(param, moment_1, moment_2, &gap);
        });
    outputs(caught)
}

fn outputs(stepped: [BufferMut; 3]) -> AdamOutputs<Flex> {
    let [param, moment_1, moment_2] = stepped.map(BufferMut::into_tensor);
    AdamOutputs {
        param,
        moment_1,
        moment_2,
    }
}

/// An [`AdamGap`] in the precision of the tensors.
struct Gap<T> {
    keep_1: T,
    keep_2: T,
    step: T,
    epsilon: T,
}

vectorized! {
    /// Does to a slice of elements what steps without a gradient do.
    fn drift<T: Real, const FMA: bool>(
        param: &mut [T],
        moment_1: &mut [T],
        moment_2: &mut [T],
        gap: &Gap<T>,
    ) {
        let elements = param.iter_mut().zip(moment_1).zip(moment_2);
        for ((param, moment_1), moment_2) in elements {
            *param -= *moment_1 / (moment_2.sqrt() + gap.epsilon) * gap.step;
            *moment_1 = *moment_1 * gap.keep_1;
            *moment_2 = *moment_2 * gap.keep_2;
        }
    }
}

vectorized! {
    /// Steps a slice of elements.
    fn update<T: Real, const FMA: bool>(
        param: &mut [T],
        moment_1: &mut [T],
        moment_2: &mut [T],
        grad: &[T],
        numbers: &Numbers<T>,
    ) {
        let elements = param.iter_mut().zip(moment_1).zip(moment_2).zip(grad);
        for (((param, moment_1), moment_2), grad) in elements {
            let usable = (*grad * *grad).is_finite();
            let g = if usable { *grad } else { T::ZERO };
            let m = *moment_1 * numbers.beta_1 + g * numbers.rest_1;
            let v = *moment_2 * numbers.beta_2 + g * g * numbers.rest_2;
            *moment_1 = m;
            *moment_2 = v;
            *param -= m / (v.sqrt() + numbers.epsilon) * numbers.rate;
        }
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::TensorData;

    use super::*;

    const STEP: AdamStep = AdamStep {
        beta_1: 0.9,
        beta_2: 0.999,
        rate: 0.1,
        epsilon: 1e-8,
        rows: AdamRows::All,
    };

    fn tensor(values: &[f32]) -> FlexTensor {
        FlexTensor::from_data(TensorData::new(values.to_vec(), [values.len() / 2, 2]))
    }

    fn stepped(tensors: [FlexTensor; 4]) -> [FlexTensor; 3] {
        let stepped = step(PhantomData::<f32>, tensors.into(), &STEP);
        [stepped.param, stepped.moment_1, stepped.moment_2]
    }

    fn values(tensor: &FlexTensor) -> &[f32] {
        tensor.as_slice().unwrap()
    }

    #[test]
    fn memory_that_nobody_else_holds_is_written_in_place() {
        let start = [1.0, -2.0, 0.5, 3.0];
        let tensors = || [start, [0.1, 0.0, -0.2, 0.3], [0.0; 4], [0.0; 4]].map(|v| tensor(&v));

        let alone = tensors();
        let places = [0, 2, 3].map(|i| values(&alone[i]).as_ptr());
        let stepped = self::stepped(alone);
        assert_eq!(places, stepped.each_ref().map(|t| values(t).as_ptr()));
        assert_ne!(values(&stepped[0]), start);

        let shared = tensors();
        let held = shared.clone();
        let again = self::stepped(shared);
        assert_eq!(values(&held[0]), start);
        for (stepped, again) in stepped.iter().zip(&again) {
            assert_eq!(values(stepped), values(again));
        }
    }
}
