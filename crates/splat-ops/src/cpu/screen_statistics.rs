//! Sums of screen gradients, in one pass and in place.

use core::marker::PhantomData;

use burn::backend::flex::FlexTensor;
use burn::backend::{Flex, TensorMetadata};
use rayon::prelude::*;

use super::buffer::BufferMut;
use super::real::Real;
use super::row_groups::chosen;
use crate::backend::{
    OpInputs, PROJECTED_EXTENT, ScreenProbeOps, ScreenStatisticsInputs, ScreenStatisticsOps,
    ScreenStatisticsOutputs, ScreenStatisticsTensors,
};
use crate::settings::RowGroups;

/// Gaussians per unit of parallel work, at least.
const CHUNK: usize = 4096;

/// `[C, N, 9]` or `[C, N, 2]`, read where it lies.
struct Rows<'a, T> {
    values: &'a [T],
    start: usize,
    strides: [usize; 3],
}

impl<'a, T: Real> Rows<'a, T> {
    fn new(tensor: &'a FlexTensor) -> Self {
        let layout = tensor.layout();
        let stride = |axis: usize| layout.strides()[axis] as usize;
        Self {
            values: tensor.storage(),
            start: layout.start_offset(),
            strides: [stride(0), stride(1), stride(2)],
        }
    }

    #[inline(always)]
    fn at(&self, c: usize, n: usize, i: usize) -> T {
        self.values[self.start + c * self.strides[0] + n * self.strides[1] + i * self.strides[2]]
    }
}

impl ScreenProbeOps for Flex {}

impl ScreenStatisticsOps for Flex {
    fn add_screen_statistics(
        OpInputs(inputs): ScreenStatisticsInputs<Self>,
        half: [f64; 2],
        rows: Option<RowGroups>,
    ) -> ScreenStatisticsOutputs<Self> {
        in_precision!(inputs.gradient, add, inputs, half, rows)
    }
}

fn add<T: Real>(
    _: PhantomData<T>,
    inputs: ScreenStatisticsTensors<FlexTensor>,
    half: [f64; 2],
    rows: Option<RowGroups>,
) -> ScreenStatisticsOutputs<Flex> {
    let ScreenStatisticsTensors {
        gradient,
        packed,
        gradients,
        views,
    } = inputs;
    let cameras = gradient.shape()[0];
    // A flipped view would have strides below zero.
    let [gradient, packed] = [gradient, packed].map(|tensor| {
        if tensor.layout().strides().iter().any(|stride| *stride < 0) {
            tensor.to_contiguous()
        } else {
            tensor
        }
    });
    let (gradient, packed) = (Rows::<T>::new(&gradient), Rows::<T>::new(&packed));
    let [width, height] = half.map(T::of);
    let mut sums = [gradients, views].map(BufferMut::new);
    let [gradients, views] = sums.each_mut().map(|buffer| buffer.slice::<T>());
    let add = |n: usize, total: &mut T, views: &mut T| {
        let (mut sum, mut count) = (T::ZERO, T::ZERO);
        for c in 0..cameras {
            if packed.at(c, n, PROJECTED_EXTENT) > T::ZERO {
                let (x, y) = (gradient.at(c, n, 0) * width, gradient.at(c, n, 1) * height);
                let length = (x * x + y * y).sqrt();
                // One that is not finite must not hide the other views of the same Gaussian.
                sum += if length.is_finite() { length } else { T::ZERO };
                count += T::ONE;
            }
        }
        *total += sum;
        *views += count;
    };
    match rows {
        None => gradients
            .par_iter_mut()
            .zip(views)
            .enumerate()
            .with_min_len(CHUNK)
            .for_each(|(n, (total, views))| add(n, total, views)),
        Some(rows) => {
            let size = rows.size();
            let of_groups = gradients.chunks_mut(size).zip(views.chunks_mut(size));
            let parts = chosen(&rows, of_groups).into_par_iter().enumerate();
            parts.for_each(|(part, (totals, views))| {
                let sums = totals.iter_mut().zip(views).enumerate();
                sums.for_each(|(row, (total, views))| add(part * size + row, total, views));
            });
        }
    }
    let [gradients, views] = sums.map(BufferMut::into_tensor);
    ScreenStatisticsOutputs { gradients, views }
}
