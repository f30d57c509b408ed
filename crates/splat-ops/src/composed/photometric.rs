//! The loss, and structural similarity.

use core::ops::Range;

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, TensorMetadata};
use burn::tensor::{Shape, Slice};

use crate::backend::{BlurOps, OpInputs, SsimBackend, SsimGradients, SsimTensors, Target};
use crate::settings::SsimArgs;
use crate::ssim::counted;

/// A, B, C, D of the structural similarity `A C / (B D)`, from the four windowed means.
fn ssim_terms<B: Backend>(moments: &[FloatTensor<B>], args: &SsimArgs) -> [FloatTensor<B>; 4] {
    let [mx, my, q, p] = [0, 1, 2, 3].map(|i| moments[i].clone());
    let product = B::float_mul(mx.clone(), my.clone());
    let squares = B::float_add(B::float_mul(mx.clone(), mx), B::float_mul(my.clone(), my));
    let twice_and = |v, constant: f64| {
        let twice = B::float_mul_scalar(v, 2.0.into());
        B::float_add_scalar(twice, constant.into())
    };
    [
        twice_and(product.clone(), args.c1),
        B::float_add_scalar(squares.clone(), args.c1.into()),
        twice_and(B::float_sub(p, product), args.c2),
        B::float_add_scalar(B::float_sub(q, squares), args.c2.into()),
    ]
}

/// [`ssim_map`](crate::ssim_map), and the windowed means of x, y, x^2 + y^2 and xy.
pub(crate) fn ssim_forward<B: BlurOps>(
    SsimTensors { x, y }: SsimTensors<FloatTensor<B>>,
    args: &SsimArgs,
) -> (FloatTensor<B>, Vec<FloatTensor<B>>) {
    let square = |v: &FloatTensor<B>| B::float_mul(v.clone(), v.clone());
    let squares = B::float_add(square(&x), square(&y));
    let product = B::float_mul(x.clone(), y.clone());
    let moments: Vec<_> = [x, y, squares, product]
        .into_iter()
        .map(|image| B::gaussian_blur(image, args.window.clone()))
        .collect();
    let [a, b, c, d] = ssim_terms::<B>(&moments, args);
    (
        B::float_div(B::float_mul(a, c), B::float_mul(b, d)),
        moments,
    )
}

/// The gradients of [`ssim_forward`]; see the formulas in `cpu/photometric/sweep.rs`.
pub(crate) fn ssim_backward<B: BlurOps>(
    SsimTensors { x, y }: SsimTensors<FloatTensor<B>>,
    moments: &[FloatTensor<B>],
    grad: FloatTensor<B>,
    args: &SsimArgs,
    needs_grad: SsimTensors<bool>,
) -> SsimGradients<B> {
    let [a, b, c, d] = ssim_terms::<B>(moments, args);
    let mul = |l: &FloatTensor<B>, r: &FloatTensor<B>| B::float_mul(l.clone(), r.clone());
    let div = |l: &FloatTensor<B>, r: &FloatTensor<B>| B::float_div(l.clone(), r.clone());
    let twice = |v: FloatTensor<B>| B::float_mul_scalar(v, 2.0.into());
    let blur = |v: FloatTensor<B>| B::gaussian_blur(v, args.window.clone());

    let scaled = div(&grad, &mul(&b, &d));
    let weighted = mul(&scaled, &mul(&a, &c));
    let slope = B::float_sub(div(&weighted, &d), div(&weighted, &b));
    let contrast = mul(&scaled, &B::float_sub(c, a.clone()));
    let by_squares = twice(blur(B::float_neg(div(&weighted, &d))));
    let by_product = blur(twice(mul(&scaled, &a)));
    let gradient = |own: &FloatTensor<B>, other: &FloatTensor<B>, mine: usize| {
        let theirs = 1 - mine;
        let by_mean = blur(twice(B::float_add(
            mul(&moments[theirs], &contrast),
            mul(&moments[mine], &slope),
        )));
        let rest = B::float_add(mul(own, &by_squares), mul(other, &by_product));
        B::float_add(by_mean, rest)
    };
    SsimTensors {
        x: needs_grad.x.then(|| gradient(&x, &y, 0)),
        y: needs_grad.y.then(|| gradient(&y, &x, 1)),
    }
}

/// The target as values, and as many channels of what was rendered.
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

/// Where in `[B, H, W, D]` the values lie that count for the mean similarity.
fn counted_part<B: Backend>(map: &FloatTensor<B>, args: &SsimArgs) -> [Range<usize>; 4] {
    let [b, h, w, d] = map.shape().dims();
    let [rows, columns] = counted([h, w], args.window.len());
    [0..b, rows, columns, 0..d]
}

/// The mean absolute difference, and one less the mean of the counted part of the similarity.
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

/// The same, and the gradient of the mean similarity.
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
    // A backend that has not computed what it was asked for has nothing to add.
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
