//! Structural similarity and its gradient in two passes over rows each: along the rows, then down the columns, where the
//! blurred rows are used up at once.
//!
//! ```text
//! S = A C / (B D),  A = 2 mx my + c1,  B = mx^2 + my^2 + c1,  C = 2 (p - mx my) + c2,  D = q - mx^2 - my^2 + c2
//! dS/dmx = 2 my (C - A) / (B D) + 2 mx S (1/D - 1/B),   dS/dq = -S / D,   dS/dp = 2 A / (B D)
//! dL/dx = blur(g dS/dmx) + 2 x blur(g dS/dq) + y blur(g dS/dp)
//! ```
//!
//! mx, my, q, p being the windowed means of x, y, x^2 + y^2, xy.

use core::marker::PhantomData;

use burn::backend::flex::FlexTensor;
use rayon::prelude::*;

use super::blur::Rows;
use super::buffer::{Buffer, overwritten, tensor};
use super::real::Real;
use crate::ssim::SsimArgs;

/// mx, my, q, p.
const MOMENTS: usize = 4;
/// Fields whose blur makes a gradient.
const FIELDS: usize = 3;

/// The terms of S at one pixel.
struct Terms<T> {
    a: T,
    b: T,
    c: T,
    d: T,
}

impl<T: Real> Terms<T> {
    #[inline(always)]
    fn new([mx, my, q, p]: [T; MOMENTS], c1: T, c2: T) -> Self {
        let two = T::ONE + T::ONE;
        let (product, squares) = (mx * my, mx * mx + my * my);
        Self {
            a: two * product + c1,
            b: squares + c1,
            c: two * (p - product) + c2,
            d: q - squares + c2,
        }
    }

    #[inline(always)]
    fn similarity(&self) -> T {
        self.a * self.c / (self.b * self.d)
    }
}

pub(super) fn forward<T: Real>(
    _: PhantomData<T>,
    images: [FlexTensor; 2],
    args: &SsimArgs,
) -> (FlexTensor, Vec<FlexTensor>) {
    let images = images.map(Buffer::new);
    let shape: [usize; 4] = images[0].dims();
    let [x, y] = images.each_ref().map(|image| image.slice::<T>());
    let rows = Rows::<T>::new(shape, &args.window);
    let (c1, c2) = (T::of(args.c1), T::of(args.c2));
    let mut map = overwritten::<T>(x.len());
    let mut moments = overwritten::<T>(MOMENTS * x.len());
    if !x.is_empty() {
        let planes = rows.along::<MOMENTS>(|row, [mx, my, q, p]| {
            let (x, y) = (&x[rows.range(row)], &y[rows.range(row)]);
            mx.copy_from_slice(x);
            my.copy_from_slice(y);
            for i in 0..x.len() {
                q[i] = x[i] * x[i] + y[i] * y[i];
                p[i] = x[i] * y[i];
            }
        });
        map.par_chunks_mut(rows.length)
            .zip(moments.par_chunks_mut(MOMENTS * rows.length))
            .enumerate()
            .for_each(|(row, (map, moments))| {
                rows.down::<MOMENTS>(&planes, row, moments);
                for (i, out) in map.iter_mut().enumerate() {
                    *out = Terms::new(at(moments, rows.length, i), c1, c2).similarity();
                }
            });
    }
    let [b, h, w, d] = shape;
    (
        tensor(map, shape),
        vec![tensor(moments, [b, h, MOMENTS, w, d])],
    )
}

/// The moments of value i of a row.
#[inline(always)]
fn at<T: Real>(moments: &[T], length: usize, i: usize) -> [T; MOMENTS] {
    core::array::from_fn(|n| moments[n * length + i])
}

pub(super) fn backward<T: Real>(
    _: PhantomData<T>,
    images: [FlexTensor; 2],
    moments: Vec<FlexTensor>,
    grad: FlexTensor,
    args: &SsimArgs,
    wanted: [bool; 2],
) -> [Option<FlexTensor>; 2] {
    let images = images.map(Buffer::new);
    let shape: [usize; 4] = images[0].dims();
    // The forward keeps one tensor.
    let (grad, moments) = (Buffer::new(grad), Buffer::new(moments[0].clone()));
    let [x, y] = images.each_ref().map(|image| image.slice::<T>());
    let gradient = |own: &[T], other: &[T], swapped: bool| {
        tensor(
            gradient(
                [own, other],
                moments.slice(),
                grad.slice(),
                &Rows::new(shape, &args.window),
                [args.c1, args.c2].map(T::of),
                swapped,
            ),
            shape,
        )
    };
    [
        wanted[0].then(|| gradient(x, y, false)),
        wanted[1].then(|| gradient(y, x, true)),
    ]
}

/// The gradient of `own`; `swapped` where that is y.
fn gradient<T: Real>(
    [own, other]: [&[T]; 2],
    moments: &[T],
    grad: &[T],
    rows: &Rows<T>,
    [c1, c2]: [T; 2],
    swapped: bool,
) -> Vec<T> {
    let two = T::ONE + T::ONE;
    let mut out = overwritten::<T>(own.len());
    if out.is_empty() {
        return out;
    }
    let planes = rows.along::<FIELDS>(|row, [by_mean, by_squares, by_product]| {
        let moments = &moments[row * MOMENTS * rows.length..][..MOMENTS * rows.length];
        let grad = &grad[rows.range(row)];
        for i in 0..rows.length {
            let [mx, my, q, p] = at(moments, rows.length, i);
            let (mine, theirs) = if swapped { (my, mx) } else { (mx, my) };
            let terms = Terms::new([mx, my, q, p], c1, c2);
            let similarity = terms.similarity();
            let scale = T::ONE / (terms.b * terms.d);
            by_mean[i] = grad[i]
                * two
                * (theirs * (terms.c - terms.a) * scale
                    + mine * similarity * (T::ONE / terms.d - T::ONE / terms.b));
            by_squares[i] = -grad[i] * similarity / terms.d;
            by_product[i] = grad[i] * two * terms.a * scale;
        }
    });
    out.par_chunks_mut(rows.length).enumerate().for_each_init(
        || vec![T::ZERO; FIELDS * rows.length],
        |blurred, (row, out)| {
            rows.down::<FIELDS>(&planes, row, blurred);
            let (own, other) = (&own[rows.range(row)], &other[rows.range(row)]);
            let (by_mean, rest) = blurred.split_at(rows.length);
            let (by_squares, by_product) = rest.split_at(rows.length);
            for i in 0..out.len() {
                out[i] = by_mean[i] + two * own[i] * by_squares[i] + other[i] * by_product[i];
            }
        },
    );
    out
}
