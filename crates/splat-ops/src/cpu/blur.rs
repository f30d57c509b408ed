//! Separable convolution of images with a symmetric window, zeros outside.

use core::marker::PhantomData;

use burn::backend::flex::FlexTensor;
use rayon::prelude::*;

use super::buffer::{Buffer, overwritten, tensor};
use super::real::Real;
use super::simd::vectorized;

/// Values of a row that are summed at once.
const LANES: usize = 16;

pub(super) fn blur<T: Real>(_: PhantomData<T>, image: FlexTensor, window: &[f64]) -> FlexTensor {
    let image = Buffer::new(image);
    let shape: [usize; 4] = image.dims();
    let image = image.slice::<T>();
    let rows = Rows::<T>::new(shape, window);
    let mut blurred = overwritten::<T>(image.len());
    if !image.is_empty() {
        let planes = rows.along::<1>(|row, [out]| out.copy_from_slice(&image[rows.range(row)]));
        blurred
            .par_chunks_mut(rows.length)
            .enumerate()
            .for_each(|(row, out)| rows.down::<1>(&planes, row, out));
    }
    tensor(blurred, shape)
}

/// Rows of images `[B, H, W, D]`, and the window over them.
pub(super) struct Rows<T> {
    /// H.
    height: usize,
    /// W D.
    pub(super) length: usize,
    /// D.
    pixel: usize,
    count: usize,
    window: Vec<T>,
}

impl<T: Real> Rows<T> {
    pub(super) fn new([b, h, w, d]: [usize; 4], window: &[f64]) -> Self {
        Self {
            height: h,
            length: w * d,
            pixel: d,
            count: b * h,
            window: window.iter().map(|weight| T::of(*weight)).collect(),
        }
    }

    pub(super) fn range(&self, row: usize) -> core::ops::Range<usize> {
        row * self.length..(row + 1) * self.length
    }

    /// Blurs N fields along the rows: `fill` writes the fields of a row, the result holds N blurred rows
    /// per row.
    pub(super) fn along<const N: usize>(
        &self,
        fill: impl Fn(usize, [&mut [T]; N]) + Sync,
    ) -> Vec<T> {
        let margin = self.window.len() / 2 * self.pixel;
        let mut planes = overwritten::<T>(N * self.count * self.length);
        planes
            .par_chunks_mut(N * self.length)
            .enumerate()
            .for_each_init(
                || core::array::from_fn::<_, N, _>(|_| vec![T::ZERO; self.length + 2 * margin]),
                |padded, (row, out)| {
                    fill(
                        row,
                        padded
                            .each_mut()
                            .map(|p| &mut p[margin..margin + self.length]),
                    );
                    for (out, padded) in out.chunks_exact_mut(self.length).zip(padded) {
                        let sources: Vec<&[T]> = (0..self.window.len())
                            .map(|k| &padded[k * self.pixel..][..self.length])
                            .collect();
                        weighted_sum(out, &sources, &self.window);
                    }
                },
            );
        planes
    }

    /// Blurs the planes of [`along`](Self::along) down the columns, one row, into `out` (N rows).
    pub(super) fn down<const N: usize>(&self, planes: &[T], row: usize, out: &mut [T]) {
        let radius = self.window.len() / 2;
        let (first, y) = (row - row % self.height, row % self.height);
        let inside = |k: &usize| (radius..self.height + radius).contains(&(y + k));
        for (n, out) in out.chunks_exact_mut(self.length).enumerate() {
            let (weights, sources): (Vec<T>, Vec<&[T]>) = (0..self.window.len())
                .filter(inside)
                .map(|k| {
                    let start = ((first + y + k - radius) * N + n) * self.length;
                    (self.window[k], &planes[start..start + self.length])
                })
                .unzip();
            weighted_sum(out, &sources, &weights);
        }
    }
}

vectorized! {
    /// `out[i] = sum of weights[k] sources[k][i]`, all of one length.
    fn weighted_sum<T: Real, const FMA: bool>(out: &mut [T], sources: &[&[T]], weights: &[T]) {
        let whole = out.len() - out.len() % LANES;
        for start in (0..whole).step_by(LANES) {
            let mut sums = [T::ZERO; LANES];
            for (source, weight) in sources.iter().zip(weights) {
                let source = &source[start..start + LANES];
                for i in 0..LANES {
                    sums[i] = T::multiply_add::<FMA>(*weight, source[i], sums[i]);
                }
            }
            out[start..start + LANES].copy_from_slice(&sums);
        }
        for i in whole..out.len() {
            let mut sum = T::ZERO;
            for (source, weight) in sources.iter().zip(weights) {
                sum = T::multiply_add::<FMA>(*weight, source[i], sum);
            }
            out[i] = sum;
        }
    }
}
