//! Structural similarity of two images (Wang et al. 2004) and its gradient, in two launches each: a
//! separable window along the rows, then along the columns.
//!
//! ```text
//! S = A C / (B D),  A = 2 mx my + c1,  B = mx² + my² + c1,  C = 2 (p - mx my) + c2,  D = q - mx² - my² + c2
//! dS/dmx = 2 my (C - A) / (B D) + 2 mx S (1/D - 1/B),   dS/dq = -S / D,   dS/dp = 2 A / (B D)
//! dL/dx = blur(g dS/dmx) + 2 x blur(g dS/dq) + y blur(g dS/dp)
//! ```
//! mx, my, q, p: windowed means of x, y, x² + y², xy. A unit makes eight neighbouring values of
//! each, so that each value read serves several: with the window of 11, 18 reads instead of 88.
//!
//! Floor per pixel and channel. Forward: 8 bytes read, 4 written, and 16 written to be kept; 2 x 4
//! x 11 fused multiply-adds. Gradient: 28 bytes read, 4 written; 2 x 3 x 11 fused multiply-adds.

mod kernels;

use cubecl::prelude::*;

use self::kernels::{
    FIELDS, MOMENTS, fields_along_rows, gradient_down_columns, moments_along_rows,
    similarity_down_columns,
};
pub(crate) use self::kernels::{RUN, UNROLLED_TAPS, load_window, terms, windowed};
use crate::launch::{Buffer, per_element};

/// Images and the window.
#[derive(Clone, Copy, Debug)]
pub struct SsimShape {
    /// B, images.
    pub images: usize,
    /// Height in pixels.
    pub height: usize,
    /// Width in pixels.
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

/// Lines of values along one axis: `lines` lines of `size` values, `stride` apart.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Axis {
    size: u32,
    stride: u32,
    /// Units per line; each makes [`RUN`] values.
    runs: u32,
    /// Total number of units.
    units: u32,
    /// Values of one field.
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

/// S of every value of `images` (x, y, both [B, H, W, D]), and mx, my, q, p [4, B, H, W, D] for the
/// gradient.
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

/// Gradients of both images, from the gradient `grad` of S [B, H, W, D]; only those that
/// `needs_grad` names.
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
