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
    let [b, h, w, d] = image.dims();
    let image = image.slice::<T>();
    let window: Vec<T> = window.iter().map(|value| T::of(*value)).collect();
    let radius = window.len() / 2;
    let row = w * d;
    let mut rows_done = overwritten::<T>(image.len());
    let mut all_done = overwritten::<T>(image.len());
    if image.is_empty() {
        return tensor(all_done, [b, h, w, d]);
    }

    // Along a row one pixel is d values further; zeros before and after stand for the outside.
    rows_done
        .par_chunks_mut(row)
        .zip(image.par_chunks(row))
        .for_each_init(
            || vec![T::ZERO; row + 2 * radius * d],
            |padded, (out, input)| {
                padded[radius * d..][..row].copy_from_slice(input);
                let sources: Vec<&[T]> =
                    (0..window.len()).map(|k| &padded[k * d..][..row]).collect();
                weighted_sum(out, &sources, &window);
            },
        );
    // Along a column one pixel is one row further.
    all_done
        .par_chunks_mut(row)
        .enumerate()
        .for_each(|(index, out)| {
            let (image, y) = (index / h, index % h);
            let inside = |k: &usize| (radius..h + radius).contains(&(y + k));
            let (weights, sources): (Vec<T>, Vec<&[T]>) = (0..window.len())
                .filter(inside)
                .map(|k| {
                    let start = (image * h + y + k - radius) * row;
                    (window[k], &rows_done[start..start + row])
                })
                .unzip();
            weighted_sum(out, &sources, &weights);
        });
    tensor(all_done, [b, h, w, d])
}

vectorized! {
    /// `out[i] = sum of weights[k] sources[k][i]`, all of one length.
    pub(super) fn weighted_sum<T: Real, const FMA: bool>(out: &mut [T], sources: &[&[T]], weights: &[T]) {
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
