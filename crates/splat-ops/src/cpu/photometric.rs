//! Mean absolute difference and mean structural similarity of two images in one sweep over their
//! rows, with the gradient of the similarity. The gradient of the loss then takes one more pass.

mod pictures;
mod rows;
mod sweep;

use core::marker::PhantomData;
use core::ops::RangeInclusive;

use burn::backend::flex::FlexTensor;
use burn::backend::{Flex, TensorMetadata};
use rayon::prelude::*;

use super::buffer::{Buffer, tensor};
use super::real::Real;
use super::uninit::{Part, Uncleared};
use crate::backend::{PhotometricBackend, PhotometricOps, Target};
use crate::settings::SsimArgs;
use pictures::{Pictures, spread};
use sweep::{Scratch, Sweep};

/// Rows per unit of parallel work. Both neighbours compute the rows that the window reaches beyond
/// a band, so small bands are expensive; large ones balance badly at the end.
const BAND: RangeInclusive<usize> = 32..=128;

impl PhotometricOps for Flex {
    fn photometric(rendered: FlexTensor, target: Target<Self>, args: SsimArgs) -> FlexTensor {
        in_precision!(rendered, measure, rendered, target, &args)
    }
}

impl PhotometricBackend for Flex {
    fn photometric_tracked(
        rendered: FlexTensor,
        target: Target<Self>,
        args: &SsimArgs,
    ) -> (FlexTensor, FlexTensor) {
        in_precision!(rendered, measure_tracked, rendered, target, args)
    }

    fn photometric_backward(
        rendered: FlexTensor,
        target: Target<Self>,
        kept: FlexTensor,
        grad_losses: FlexTensor,
        _args: &SsimArgs,
    ) -> FlexTensor {
        in_precision!(rendered, backward, rendered, target, kept, grad_losses)
    }
}

/// The mean absolute difference and one minus the mean similarity, `[2]`.
fn measure<T: Real>(
    _: PhantomData<T>,
    rendered: FlexTensor,
    target: Target<Flex>,
    args: &SsimArgs,
) -> FlexTensor {
    means::<T>(&Pictures::new(rendered, target), args, None)
}

/// [`measure`], with the gradient of the mean similarity.
fn measure_tracked<T: Real>(
    _: PhantomData<T>,
    rendered: FlexTensor,
    target: Target<Flex>,
    args: &SsimArgs,
) -> (FlexTensor, FlexTensor) {
    let pictures = Pictures::new(rendered, target);
    let mut slope = Uncleared::<T>::new(pictures.shape.iter().product());
    let means = means(&pictures, args, Some(&mut slope));
    (means, tensor(slope.written(), pictures.shape))
}

fn means<T: Real>(
    pictures: &Pictures,
    args: &SsimArgs,
    slope: Option<&mut Uncleared<T>>,
) -> FlexTensor {
    let [b, h, w, d] = pictures.shape;
    let sweep = Sweep::<T>::new(pictures, args);
    let band = rows_of_band(b * h);
    // Sums per row, so that the result does not depend on the number of bands.
    let mut sums = vec![[0.0; 2]; b * h];
    let mut bands: Vec<Band<T>> = sums
        .chunks_mut(h.max(1))
        .enumerate()
        .flat_map(|(image, sums)| {
            let bands = sums.chunks_mut(band).enumerate();
            bands.map(move |(index, sums)| Band {
                image,
                first: index * band,
                sums,
                slope: None,
            })
        })
        .collect();
    if let Some(slope) = slope {
        let parts = slope.chunks_of_each(b, band * w * d);
        for (band, (.., part)) in bands.iter_mut().zip(parts) {
            band.slope = Some(part);
        }
    }
    bands
        .into_par_iter()
        // Without this the last bands would often be left to one thread.
        .with_max_len(1)
        .for_each_init(Scratch::default, |scratch, band| {
            let slope = band.slope.map(Part::overwritten);
            sweep.band(band.image, band.first, band.sums, slope, scratch);
        });
    let counts = [b * h * w * d, sweep.count];
    let [l1, ssim] = [0, 1].map(|i| {
        let sum: f64 = sums.iter().map(|sums| sums[i]).sum();
        sum / counts[i] as f64
    });
    tensor(vec![T::of(l1), T::of(1.0 - ssim)], [2])
}

/// Two bands per thread, within the limits of the band size.
fn rows_of_band(rows: usize) -> usize {
    let even = rows.div_ceil(2 * rayon::current_num_threads());
    even.next_multiple_of(2).clamp(*BAND.start(), *BAND.end())
}

/// Rows of one image: their sums, and the memory for the gradient of the similarity, if wanted.
struct Band<'a, T> {
    image: usize,
    first: usize,
    sums: &'a mut [[f64; 2]],
    slope: Option<Part<'a, T>>,
}

/// Gradient of `rendered`, from the gradient of the means and the results of [`measure_tracked`].
fn backward<T: Real>(
    _: PhantomData<T>,
    rendered: FlexTensor,
    target: Target<Flex>,
    slope: FlexTensor,
    grad: FlexTensor,
) -> FlexTensor {
    let [.., e] = rendered.shape().dims::<4>();
    let pictures = Pictures::new(rendered, target);
    let [b, h, w, d] = pictures.shape;
    let [slope, grad] = [slope, grad].map(Buffer::new);
    let (slope, grad) = (slope.slice::<T>(), grad.slice::<T>());
    let weights = [grad[0] / T::of((b * h * w * d) as f64), -grad[1]];
    let rows = pictures.rows::<T>();
    let mut out = Uncleared::<T>::new(b * h * w * e);
    let parts = out.chunks(w * e).into_par_iter();
    parts.enumerate().for_each_init(
        || [(); 3].map(|()| vec![T::ZERO; w * d]),
        |[x, y, gradient], (row, out)| {
            rows.load(row, 0..w, x, y);
            let slope = &slope[row * w * d..(row + 1) * w * d];
            rows::gradient([x, y, slope], weights, gradient);
            spread([d, e], gradient, out.overwritten());
        },
    );
    tensor(out.written(), [b, h, w, e])
}
