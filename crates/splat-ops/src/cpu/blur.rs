//! Separable convolution of images with a symmetric window, zeros outside.

use core::marker::PhantomData;

use burn::backend::flex::FlexTensor;
use rayon::prelude::*;

use super::buffer::{Buffer, tensor};
use super::real::Real;

pub(super) fn blur<T: Real>(_: PhantomData<T>, image: FlexTensor, window: &[f64]) -> FlexTensor {
    let image = Buffer::new(image);
    let [b, h, w, d] = image.dims();
    let image = image.slice::<T>();
    let window: Vec<T> = window.iter().map(|value| T::of(*value)).collect();
    let row = w * d;
    let mut rows_done = vec![T::ZERO; image.len()];
    let mut all_done = vec![T::ZERO; image.len()];
    if image.is_empty() {
        return tensor(all_done, [b, h, w, d]);
    }

    // Along a row one pixel is d values further.
    rows_done
        .par_chunks_mut(row)
        .zip(image.par_chunks(row))
        .for_each(|(out, input)| convolve(out, &window, |shift| shifted(input, shift, d)));
    // Along a column one pixel is one row further.
    all_done
        .par_chunks_mut(row)
        .enumerate()
        .for_each(|(index, out)| {
            let (image, y) = (index / h, index % h);
            convolve(out, &window, |shift| {
                let source = y.checked_add_signed(shift).filter(|y| *y < h)?;
                let start = (image * h + source) * row;
                Some((0, &rows_done[start..start + row]))
            });
        });
    tensor(all_done, [b, h, w, d])
}

/// `out += window[k] * input moved by k`, where `source` gives, for a shift, the part of the input
/// that lands inside and where in `out` it begins.
fn convolve<'a, T: Real>(
    out: &mut [T],
    window: &[T],
    source: impl Fn(isize) -> Option<(usize, &'a [T])>,
) {
    let radius = (window.len() / 2) as isize;
    for (k, weight) in window.iter().enumerate() {
        let Some((start, input)) = source(k as isize - radius) else {
            continue;
        };
        for (out, value) in out[start..].iter_mut().zip(input) {
            *out += *weight * *value;
        }
    }
}

/// A row read `shift` pixels further on: `out[i] = input[i + shift]` where that exists.
fn shifted<T>(input: &[T], shift: isize, pixel: usize) -> Option<(usize, &[T])> {
    let offset = shift.unsigned_abs() * pixel;
    if offset >= input.len() {
        return None;
    }
    Some(if shift < 0 {
        (offset, &input[..input.len() - offset])
    } else {
        (0, &input[offset..])
    })
}
