//! Kernels of structural similarity: along rows and columns, forward and backward.

use cubecl::prelude::*;

use super::Axis;

/// Values along the window's axis per unit.
pub(crate) const RUN: usize = 8;
/// Longest window with unrolled loops, which keep values in registers.
pub(crate) const UNROLLED_TAPS: usize = 16;
/// Fields kept by the forward pass: mx, my, q, p.
pub(super) const MOMENTS: usize = 4;
/// Fields whose blur makes a gradient.
pub(super) const FIELDS: usize = 3;

/// Position of a unit: index of the line's first value, and its start along the line. Adjacent
/// units take adjacent lines.
#[cube]
fn place(axis: Axis, unit: u32) -> (u32, u32) {
    let across = unit % axis.stride;
    let rest = unit / axis.stride;
    let run = rest % axis.runs;
    let line = rest / axis.runs;
    (
        line * axis.size * axis.stride + across,
        run * comptime!(RUN as u32),
    )
}

/// Index of the value `ahead` of position `along - radius` of a line, and whether it lies on the
/// line; if not, the index of the line's first value.
#[cube]
fn neighbour(axis: Axis, first: u32, along: u32, ahead: u32, radius: u32) -> (usize, bool) {
    let shifted = along + ahead;
    let inside = shifted >= radius && shifted - radius < axis.size;
    let steps = select(inside, shifted - radius, 0u32);
    ((first + steps * axis.stride) as usize, inside)
}

/// `sums[o] = Σ_k window[k] values[o + k]`
#[cube]
pub(crate) fn windowed(
    values: &Array<f32>,
    window: &Array<f32>,
    sums: &mut Array<f32>,
    #[comptime] taps: usize,
    #[comptime] unrolled: bool,
) {
    #[unroll]
    for o in 0..RUN {
        let mut sum = 0.0f32;
        #[unroll(unrolled)]
        for k in 0..taps {
            sum = fma(window[k], values[o + k], sum);
        }
        sums[o] = sum;
    }
}

/// Writes the values of a run that exist to the field that begins at `offset`.
#[cube]
fn store_run(sums: &Array<f32>, out: &mut [f32], offset: u32, axis: Axis, first: u32, along: u32) {
    #[unroll]
    for o in 0..RUN {
        if axis.size > along + o as u32 {
            let at = first + (along + o as u32) * axis.stride;
            out[(offset + at) as usize] = sums[o];
        }
    }
}

#[cube]
pub(crate) fn load_window(
    weights: &[f32],
    #[comptime] taps: usize,
    #[comptime] unrolled: bool,
) -> Array<f32> {
    let mut window = Array::<f32>::new(taps);
    #[unroll(unrolled)]
    for k in 0..taps {
        window[k] = weights[k];
    }
    window
}

/// Windowed means along the rows: `out[field, ...]` of x, y, x² + y², xy.
#[cube(launch)]
pub(super) fn moments_along_rows(
    x: &[f32],
    y: &[f32],
    weights: &[f32],
    out: &mut [f32],
    axis: Axis,
    #[comptime] taps: usize,
) {
    let unrolled = comptime!(taps <= UNROLLED_TAPS);
    let span = comptime!(RUN + taps - 1);
    let unit = ABSOLUTE_POS as u32;
    if unit < axis.units {
        let (first, along) = place(axis, unit);
        let window = load_window(weights, taps, unrolled);
        let mut xs = Array::<f32>::new(span);
        let mut ys = Array::<f32>::new(span);
        let mut products = Array::<f32>::new(span);
        #[unroll(unrolled)]
        for i in 0..span {
            let (at, inside) =
                neighbour(axis, first, along, i as u32, comptime!((taps / 2) as u32));
            xs[i] = select(inside, x[at], 0.0f32);
            ys[i] = select(inside, y[at], 0.0f32);
        }
        let mut sums = Array::<f32>::new(RUN);
        #[unroll]
        for field in 0..MOMENTS {
            #[unroll(unrolled)]
            for i in 0..span {
                if comptime!(field == 0) {
                    products[i] = xs[i];
                } else if comptime!(field == 1) {
                    products[i] = ys[i];
                } else if comptime!(field == 2) {
                    products[i] = xs[i] * xs[i] + ys[i] * ys[i];
                } else {
                    products[i] = xs[i] * ys[i];
                }
            }
            windowed(&products, &window, &mut sums, taps, unrolled);
            store_run(&sums, out, field as u32 * axis.len, axis, first, along);
        }
    }
}

/// One field, windowed along the columns.
#[cube]
fn down_columns(
    field: &[f32],
    offset: u32,
    window: &Array<f32>,
    sums: &mut Array<f32>,
    axis: Axis,
    first: u32,
    along: u32,
    #[comptime] taps: usize,
) {
    let unrolled = comptime!(taps <= UNROLLED_TAPS);
    let span = comptime!(RUN + taps - 1);
    let mut values = Array::<f32>::new(span);
    #[unroll(unrolled)]
    for i in 0..span {
        let (at, inside) = neighbour(axis, first, along, i as u32, comptime!((taps / 2) as u32));
        values[i] = select(inside, field[offset as usize + at], 0.0f32);
    }
    windowed(&values, window, sums, taps, unrolled);
}

/// The terms of S.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(crate) struct Terms {
    pub a: f32,
    pub b: f32,
    pub c: f32,
    pub d: f32,
}

#[cube]
pub(crate) fn terms(mx: f32, my: f32, q: f32, p: f32, c1: f32, c2: f32) -> Terms {
    let product = mx * my;
    let squares = mx * mx + my * my;
    Terms {
        a: 2.0f32 * product + c1,
        b: squares + c1,
        c: 2.0f32 * (p - product) + c2,
        d: q - squares + c2,
    }
}

/// Windows the moments along the columns too, and computes S.
#[cube(launch)]
pub(super) fn similarity_down_columns(
    rows: &[f32],
    weights: &[f32],
    moments: &mut [f32],
    map: &mut [f32],
    axis: Axis,
    c1: f32,
    c2: f32,
    #[comptime] taps: usize,
) {
    let unit = ABSOLUTE_POS as u32;
    if unit < axis.units {
        let (first, along) = place(axis, unit);
        let window = load_window(weights, taps, comptime!(taps <= UNROLLED_TAPS));
        let mut mx = Array::<f32>::new(RUN);
        let mut my = Array::<f32>::new(RUN);
        let mut q = Array::<f32>::new(RUN);
        let mut p = Array::<f32>::new(RUN);
        down_columns(rows, 0u32, &window, &mut mx, axis, first, along, taps);
        down_columns(rows, axis.len, &window, &mut my, axis, first, along, taps);
        down_columns(
            rows,
            2u32 * axis.len,
            &window,
            &mut q,
            axis,
            first,
            along,
            taps,
        );
        down_columns(
            rows,
            3u32 * axis.len,
            &window,
            &mut p,
            axis,
            first,
            along,
            taps,
        );
        #[unroll]
        for o in 0..RUN {
            if axis.size > along + o as u32 {
                let at = (first + (along + o as u32) * axis.stride) as usize;
                let t = terms(mx[o], my[o], q[o], p[o], c1, c2);
                let len = axis.len as usize;
                moments[at] = mx[o];
                moments[len + at] = my[o];
                moments[2 * len + at] = q[o];
                moments[3 * len + at] = p[o];
                map[at] = t.a * t.c / (t.b * t.d);
            }
        }
    }
}

/// g dS/dmean of the own image, g dS/dq and g dS/dp, windowed along the rows. `own` and `other`:
/// first value of the means of the image whose gradient it is, and of the other image.
#[cube(launch)]
pub(super) fn fields_along_rows(
    moments: &[f32],
    grad: &[f32],
    weights: &[f32],
    out: &mut [f32],
    axis: Axis,
    c1: f32,
    c2: f32,
    own: u32,
    other: u32,
    #[comptime] taps: usize,
) {
    let unrolled = comptime!(taps <= UNROLLED_TAPS);
    let span = comptime!(RUN + taps - 1);
    let unit = ABSOLUTE_POS as u32;
    if unit < axis.units {
        let (first, along) = place(axis, unit);
        let window = load_window(weights, taps, unrolled);
        let mut by_mean = Array::<f32>::new(span);
        let mut by_squares = Array::<f32>::new(span);
        let mut by_product = Array::<f32>::new(span);
        #[unroll(unrolled)]
        for i in 0..span {
            let (at, inside) =
                neighbour(axis, first, along, i as u32, comptime!((taps / 2) as u32));
            let len = axis.len as usize;
            let mine = moments[own as usize + at];
            let theirs = moments[other as usize + at];
            let t = terms(
                mine,
                theirs,
                moments[2 * len + at],
                moments[3 * len + at],
                c1,
                c2,
            );
            let g = select(inside, grad[at], 0.0f32);
            let scale = 1.0f32 / (t.b * t.d);
            let similarity = t.a * t.c * scale;
            let slope = 1.0f32 / t.d - 1.0f32 / t.b;
            by_mean[i] = g * 2.0f32 * (theirs * (t.c - t.a) * scale + mine * similarity * slope);
            by_squares[i] = -g * similarity / t.d;
            by_product[i] = g * 2.0f32 * t.a * scale;
        }
        let mut sums = Array::<f32>::new(RUN);
        #[unroll]
        for field in 0..FIELDS {
            if comptime!(field == 0) {
                windowed(&by_mean, &window, &mut sums, taps, unrolled);
            } else if comptime!(field == 1) {
                windowed(&by_squares, &window, &mut sums, taps, unrolled);
            } else {
                windowed(&by_product, &window, &mut sums, taps, unrolled);
            }
            store_run(&sums, out, field as u32 * axis.len, axis, first, along);
        }
    }
}

/// Windows the fields along the columns too, and combines them: the gradient of `own`.
#[cube(launch)]
pub(super) fn gradient_down_columns(
    rows: &[f32],
    weights: &[f32],
    own: &[f32],
    other: &[f32],
    out: &mut [f32],
    axis: Axis,
    #[comptime] taps: usize,
) {
    let unit = ABSOLUTE_POS as u32;
    if unit < axis.units {
        let (first, along) = place(axis, unit);
        let window = load_window(weights, taps, comptime!(taps <= UNROLLED_TAPS));
        let mut by_mean = Array::<f32>::new(RUN);
        let mut by_squares = Array::<f32>::new(RUN);
        let mut by_product = Array::<f32>::new(RUN);
        down_columns(rows, 0u32, &window, &mut by_mean, axis, first, along, taps);
        down_columns(
            rows,
            axis.len,
            &window,
            &mut by_squares,
            axis,
            first,
            along,
            taps,
        );
        down_columns(
            rows,
            2u32 * axis.len,
            &window,
            &mut by_product,
            axis,
            first,
            along,
            taps,
        );
        #[unroll]
        for o in 0..RUN {
            if axis.size > along + o as u32 {
                let at = (first + (along + o as u32) * axis.stride) as usize;
                out[at] = by_mean[o] + 2.0f32 * own[at] * by_squares[o] + other[at] * by_product[o];
            }
        }
    }
}
