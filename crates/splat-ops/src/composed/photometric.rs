//! The photometric loss.

use core::ops::Range;

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, TensorMetadata};
use burn::tensor::{Shape, Slice};

use crate::backend::{OpInputs, SsimBackend, SsimTensors, Target};
use crate::settings::SsimArgs;
use crate::ssim::counted;

/// The target as values, and the matching channels of the rendered images.
fn images<B: Backend>(rendered: FloatTensor<B>, target: Target<B>) -> SsimTensors<FloatTensor<B>> {
    let target = match target {
        Target::Values(values) => values,
        Target::Levels(levels) => {
            let values = B::int_into_float(levels, rendered.dtype().into());
            B::float_div_scalar(values, 255.0.into())
        }
    };
    let slices = target
        .shape()
        .dims::<4>()
        .map(|length| Slice::from(0..length));
    SsimTensors {
        x: B::float_slice(rendered, &slices),
        y: target,
    }
}

/// Slices of `[B, H, W, D]` that count for the mean similarity.
fn counted_part<B: Backend>(map: &FloatTensor<B>, args: &SsimArgs) -> [Range<usize>; 4] {
    let [b, h, w, d] = map.shape().dims();
    let [rows, columns] = counted([h, w], args.window.len());
    [0..b, rows, columns, 0..d]
}

/// The mean absolute difference, and one minus the mean similarity of the counted part.
fn losses<B: Backend>(
    SsimTensors { x, y }: SsimTensors<FloatTensor<B>>,
    map: FloatTensor<B>,
    args: &SsimArgs,
) -> FloatTensor<B> {
    let slices = counted_part::<B>(&map, args).map(Slice::from);
    let l1 = B::float_mean(B::float_abs(B::float_sub(x, y)));
    let ssim = B::float_mean(B::float_slice(map, &slices));
    let d_ssim = B::float_add_scalar(B::float_neg(ssim), 1.0.into());
    B::float_cat(vec![l1, d_ssim], 0)
}

/// [`photometric`](crate::photometric).
pub(crate) fn photometric<B: SsimBackend>(
    rendered: FloatTensor<B>,
    target: Target<B>,
    args: &SsimArgs,
) -> FloatTensor<B> {
    let images = images::<B>(rendered, target);
    let (map, _) = B::ssim_tracked(OpInputs(images.clone()), args);
    losses::<B>(images, map, args)
}

/// [`photometric`], with the gradient of the mean similarity.
pub(crate) fn photometric_tracked<B: SsimBackend>(
    rendered: FloatTensor<B>,
    target: Target<B>,
    args: &SsimArgs,
) -> (FloatTensor<B>, FloatTensor<B>) {
    let images = images::<B>(rendered, target);
    let (map, moments) = B::ssim_tracked(OpInputs(images.clone()), args);
    let (device, dtype) = (map.device(), map.dtype().into());
    let part = counted_part::<B>(&map, args);
    let shape = Shape::from(part.each_ref().map(|range| range.len()));
    let weight = (1.0 / shape.num_elements() as f64).into();
    let weights = B::float_slice_assign(
        B::float_zeros(map.shape(), &device, dtype),
        &part.map(Slice::from),
        B::float_full(shape, weight, &device, dtype),
    );
    let inputs = OpInputs(images.clone());
    let needs_grad = SsimTensors { x: true, y: false };
    let slope = B::ssim_backward(inputs, moments, weights, args, needs_grad).x;
    // A backend that was not asked for the slope contributes zero.
    let kept = slope.unwrap_or_else(|| B::float_zeros(map.shape(), &device, dtype));
    (losses::<B>(images, map, args), kept)
}

/// The gradient of [`photometric_tracked`].
pub(crate) fn photometric_backward<B: Backend>(
    rendered: FloatTensor<B>,
    target: Target<B>,
    kept: FloatTensor<B>,
    grad_losses: FloatTensor<B>,
) -> FloatTensor<B> {
    let (whole, device, dtype) = (rendered.shape(), rendered.device(), rendered.dtype().into());
    let SsimTensors { x, y } = images::<B>(rendered, target);
    let shape = x.shape();
    let scalar = |at: usize| {
        let value = B::float_slice(grad_losses.clone(), &[Slice::from(at..at + 1)]);
        B::float_reshape(value, Shape::from([1, 1, 1, 1]))
    };
    let count = shape.num_elements() as f64;
    let l1 = B::float_div_scalar(scalar(0), count.into());
    let sign = B::float_sign(B::float_sub(x, y));
    let gradient = B::float_add(
        B::float_mul(sign, l1),
        B::float_mul(kept, B::float_neg(scalar(1))),
    );
    if whole == shape {
        return gradient;
    }
    let slices = shape.dims::<4>().map(|length| Slice::from(0..length));
    B::float_slice_assign(B::float_zeros(whole, &device, dtype), &slices, gradient)
}
