//! Separable convolution of images with a symmetric window; zero outside.

use core::marker::PhantomData;

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use rayon::prelude::*;

use super::buffer::{Buffer, overwritten, tensor};
use super::real::Real;
use super::simd::vectorized;
use crate::backend::BlurOps;

/// Values of a row summed at once.
const LANES: usize = 16;

impl BlurOps for Flex {
    fn gaussian_blur(image: FlexTensor, window: Vec<f64>) -> FlexTensor {
        in_precision!(image, blur, image, &window)
    }
}

fn blur<T: Real>(_: PhantomData<T>, image: FlexTensor, window: &[f64]) -> FlexTensor {
    let image = Buffer::new(image);
    let shape: [usize; 4] = image.dims();
    let image = image.slice::<T>();
    let rows = Rows::<T>::new(shape, window);
    let mut blurred = overwritten::<T>(image.len());
    if !image.is_empty() {
        let along = rows.along(image);
        blurred
            .par_chunks_mut(rows.length)
            .enumerate()
            .for_each(|(row, out)| rows.down(&along, row, out));
    }
    tensor(blurred, shape)
}

/// Rows of images `[B, H, W, D]`, and the window.
struct Rows<T> {
    /// H.
    height: usize,
    /// W D.
    length: usize,
    /// D.
    pixel: usize,
    window: Vec<T>,
}

impl<T: Real> Rows<T> {
    fn new([_, h, w, d]: [usize; 4], window: &[f64]) -> Self {
        Self {
            height: h,
            length: w * d,
            pixel: d,
            window: window.iter().map(|weight| T::of(*weight)).collect(),
        }
    }

    /// Blurs along rows.
    fn along(&self, image: &[T]) -> Vec<T> {
        let margin = self.window.len() / 2 * self.pixel;
        let mut blurred = overwritten::<T>(image.len());
        blurred
            .par_chunks_mut(self.length)
            .zip(image.par_chunks(self.length))
            .for_each_init(
                || vec![T::ZERO; self.length + 2 * margin],
                |padded, (out, row)| {
                    padded[margin..margin + self.length].copy_from_slice(row);
                    let sources: Vec<&[T]> = (0..self.window.len())
                        .map(|k| &padded[k * self.pixel..][..self.length])
                        .collect();
                    weighted_sum(out, &sources, &self.window);
                },
            );
        blurred
    }

    /// Blurs one row of an image along the columns.
    fn down(&self, image: &[T], row: usize, out: &mut [T]) {
        let radius = self.window.len() / 2;
        let (first, y) = (row - row % self.height, row % self.height);
        let inside = |k: &usize| (radius..self.height + radius).contains(&(y + k));
        let (weights, sources): (Vec<T>, Vec<&[T]>) = (0..self.window.len())
            .filter(inside)
            .map(|k| {
                let start = (first + y + k - radius) * self.length;
                (self.window[k], &image[start..start + self.length])
            })
            .unzip();
        weighted_sum(out, &sources, &weights);
    }
}

vectorized! {
    /// `out[i] = sum of weights[k] sources[k][i]`; all slices have one length.
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
