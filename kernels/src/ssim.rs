//! Structural similarity of two images (Wang et al. 2004) and its gradient, two launches each: a separable window along
//! the rows, then down the columns.
//!
//! ```text
//! S = A C / (B D),  A = 2 mx my + c1,  B = mx² + my² + c1,  C = 2 (p - mx my) + c2,  D = q - mx² - my² + c2
//! dS/dmx = 2 my (C - A) / (B D) + 2 mx S (1/D - 1/B),   dS/dq = -S / D,   dS/dp = 2 A / (B D)
//! dL/dx = blur(g dS/dmx) + 2 x blur(g dS/dq) + y blur(g dS/dp)
//! ```
//! mx, my, q, p: windowed means of x, y, x² + y², xy. A unit makes eight neighbouring values of each, so that what it
//! reads serves several of them: with the window of 11, 18 reads instead of 88.
//!
//! Floor per pixel and channel. Forward: 8 bytes read, 4 written, and 16 written to be kept; 2 x 4 x 11 fused
//! multiply-adds. Gradient: 28 bytes read, 4 written; 2 x 3 x 11 fused multiply-adds.

use cubecl::prelude::*;

use crate::launch::{Buffer, per_element};

/// Values along the window's axis that one unit makes.
pub(crate) const RUN: usize = 8;
/// Longest window whose loops are unrolled, so that values stay in registers.
pub(crate) const UNROLLED_TAPS: usize = 16;
/// Fields in the memory that the forward keeps: mx, my, q, p.
const MOMENTS: usize = 4;
/// Fields whose blur makes a gradient.
const FIELDS: usize = 3;

/// Images and the window.
#[derive(Clone, Copy, Debug)]
pub struct SsimShape {
    /// B, images.
    pub images: usize,
    /// Pixels.
    pub height: usize,
    /// Pixels.
    pub width: usize,
    /// D.
    pub channels: usize,
    /// Constant of the luminance term.
    pub c1: f32,
    /// Constant of the contrast term.
    pub c2: f32,
}

impl SsimShape {
    fn len(&self) -> usize {
        self.images * self.height * self.width * self.channels
    }
}

/// The values that lie behind each other along one axis: `lines` lines of `size`; neighbours are `stride` apart.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Axis {
    size: u32,
    stride: u32,
    /// Units along one line: each makes [`RUN`] values.
    runs: u32,
    /// All units.
    units: u32,
    /// All values of one field.
    len: u32,
}

impl SsimShape {
    fn rows(&self) -> (usize, AxisLaunch) {
        self.axis(self.width, self.channels)
    }

    fn columns(&self) -> (usize, AxisLaunch) {
        self.axis(self.height, self.width * self.channels)
    }

    fn axis(&self, size: usize, stride: usize) -> (usize, AxisLaunch) {
        let runs = size.div_ceil(RUN);
        let units = self.len() / size.max(1) * runs;
        let axis = AxisLaunch::new(
            size as u32,
            stride as u32,
            runs as u32,
            units as u32,
            self.len() as u32,
        );
        (units, axis)
    }
}

/// Where a unit works: place of the line's first value, and how far along the line it begins. Units that lie beside
/// each other take lines that do.
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

/// Place of the value `ahead` of position `along - radius` of a line, and whether it lies on the line; the place of its
/// first value if not.
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
fn moments_along_rows(
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

/// One field, windowed down the columns.
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

/// The moments, windowed down the columns too, and S.
#[cube(launch)]
fn similarity_down_columns(
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

/// g dS/dmean of the own image, g dS/dq and g dS/dp, windowed along the rows. `own` and `other`: first value of the
/// means of the image whose gradient it is, and of the other one.
#[cube(launch)]
fn fields_along_rows(
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

/// The fields, windowed down the columns too, put together: the gradient of `own`.
#[cube(launch)]
fn gradient_down_columns(
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

/// S of every value of `images` (x, y, both [B, H, W, D]), and mx, my, q, p [4, B, H, W, D] for the gradient.
pub fn ssim(
    client: &Client,
    images: [&Buffer; 2],
    shape: &SsimShape,
    window: &[f32],
) -> (Buffer, Buffer) {
    let len = shape.len();
    let weights = Buffer::from_f32(client, window);
    let along_rows = Buffer::empty(client, MOMENTS * len);
    let moments = Buffer::empty(client, MOMENTS * len);
    let map = Buffer::empty(client, len);
    let (units, axis) = shape.rows();
    if let Some((count, dim)) = per_element(units) {
        moments_along_rows::launch(
            client,
            count,
            dim,
            images[0].arg(),
            images[1].arg(),
            weights.arg(),
            along_rows.arg(),
            axis,
            window.len(),
        );
    }
    let (units, axis) = shape.columns();
    if let Some((count, dim)) = per_element(units) {
        similarity_down_columns::launch(
            client,
            count,
            dim,
            along_rows.arg(),
            weights.arg(),
            moments.arg(),
            map.arg(),
            axis,
            shape.c1,
            shape.c2,
            window.len(),
        );
    }
    (map, moments)
}

/// Gradients of both images for the gradient `grad` of S [B, H, W, D]; only those that `needs_grad` names.
pub fn ssim_vjp(
    client: &Client,
    images: [&Buffer; 2],
    moments: &Buffer,
    grad: &Buffer,
    shape: &SsimShape,
    window: &[f32],
    needs_grad: [bool; 2],
) -> [Option<Buffer>; 2] {
    let len = shape.len();
    let weights = Buffer::from_f32(client, window);
    let gradient = |own: usize| {
        let other = 1 - own;
        let along_rows = Buffer::empty(client, FIELDS * len);
        let out = Buffer::empty(client, len);
        let (units, axis) = shape.rows();
        if let Some((count, dim)) = per_element(units) {
            fields_along_rows::launch(
                client,
                count,
                dim,
                moments.arg(),
                grad.arg(),
                weights.arg(),
                along_rows.arg(),
                axis,
                shape.c1,
                shape.c2,
                (own * len) as u32,
                (other * len) as u32,
                window.len(),
            );
        }
        let (units, axis) = shape.columns();
        if let Some((count, dim)) = per_element(units) {
            gradient_down_columns::launch(
                client,
                count,
                dim,
                along_rows.arg(),
                weights.arg(),
                images[own].arg(),
                images[other].arg(),
                out.arg(),
                axis,
                window.len(),
            );
        }
        out
    };
    [0, 1].map(|own| needs_grad[own].then(|| gradient(own)))
}
