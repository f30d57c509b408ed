//! Mean absolute difference and mean structural similarity of a rendered image and a photo, in two
//! launches: one for sums per tile, one to add them. The gradient takes one more. S and its
//! derivatives are those of [`crate::ssim`].
//!
//! A workgroup processes a tile of one channel. It windows the rows into shared memory, each unit
//! making eight neighbouring values of each moment, and then the columns from there. For the
//! gradient, three values are kept per value and channel: weight times dS/dmx, dS/dq and dS/dp. The
//! weight is one over the number of values that count, and zero for values that do not.
//!
//! Floor per pixel and channel. Forward: 4 bytes read, and 1 of an 8-bit photo or 4 of another; 12
//! written to be kept; 2 x 4 x 11 fused multiply-adds with the window of 11. Gradient: 12 bytes
//! read, and both images again; 4 written; 2 x 3 x 11 fused multiply-adds. Values under the window
//! but outside the tile are read by neighbouring tiles too, and their rows windowed twice: 26 rows
//! for 16.

mod backward;
mod forward;
mod tile;

use cubecl::prelude::*;

use self::backward::photometric_gradient;
use self::forward::{means_of_tiles, photometric_tiles};
use self::tile::{FIELDS, MOMENTS, PITCH, TILE_HEIGHT, TILE_WIDTH, UNITS};
use crate::bytes::{self, Bytes};
use crate::launch::{Buffer, CUBE_UNITS, cube_count};

/// Floors of the loss of one view and of its gradient, with an 8-bit photo.
pub(crate) fn floor(sizes: &bytes::Sizes) -> [Bytes; 2] {
    let values = sizes.pixels() * sizes.channels;
    [
        Bytes {
            read: 5 * values,
            written: 12 * values,
        },
        Bytes {
            read: 17 * values,
            written: 4 * (values + sizes.pixels()),
        },
    ]
}

/// Memory layout of a photo.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum TargetKind {
    /// 32-bit float values.
    Values,
    /// Levels as 32-bit integers; 255 means the value 1.
    Words,
    /// 8-bit levels, four per word, the first in the lowest byte.
    Bytes,
}

/// The two images: rendered, [B, H, W, E], and photo, [B, H, W, D].
#[derive(Clone, Copy, Debug)]
pub struct Images<'a> {
    /// The rendered image, f32.
    pub rendered: &'a Buffer,
    /// The photo, laid out as `kind` says.
    pub target: &'a Buffer,
    /// Layout of `target`.
    pub kind: TargetKind,
}

/// Sizes, constants and the window.
#[derive(Clone, Debug)]
pub struct PhotometricShape {
    /// B, images.
    pub images: usize,
    /// Height in pixels.
    pub height: usize,
    /// Width in pixels.
    pub width: usize,
    /// D.
    pub channels: usize,
    /// E.
    pub pixel: usize,
    /// Constant of the luminance term.
    pub c1: f32,
    /// Constant of the contrast term.
    pub c2: f32,
    /// Weights along one axis, symmetric, of odd length.
    pub window: Vec<f32>,
}

impl PhotometricShape {
    /// True if tiles of moments under this window fit into the shared memory of a workgroup.
    pub fn fits(&self, client: &Client) -> bool {
        let floats = MOMENTS * self.rows() * PITCH + UNITS;
        4 * floats <= client.properties().hardware.max_shared_memory_size
    }

    /// Rows under the windows of a tile.
    fn rows(&self) -> usize {
        TILE_HEIGHT + self.window.len() - 1
    }

    fn values(&self) -> usize {
        self.images * self.height * self.width * self.channels
    }

    fn tiles(&self) -> [usize; 2] {
        [
            self.width.div_ceil(TILE_WIDTH),
            self.height.div_ceil(TILE_HEIGHT),
        ]
    }

    /// Workgroups: one for each channel of each tile.
    fn cubes(&self) -> usize {
        let [columns, rows] = self.tiles();
        self.images * self.channels * columns * rows
    }

    /// Distance from the image edges at which a pixel counts for the mean similarity: its window
    /// must lie inside, unless no window does.
    fn margin(&self) -> usize {
        let taps = self.window.len();
        if self.height < taps || self.width < taps {
            0
        } else {
            taps / 2
        }
    }

    /// Number of values that count.
    fn counted(&self) -> usize {
        let margin = 2 * self.margin();
        self.images * (self.height - margin) * (self.width - margin) * self.channels
    }

    fn uniforms(&self) -> SizesLaunch {
        let [columns, rows] = self.tiles();
        SizesLaunch::new(
            self.images as u32,
            self.height as u32,
            self.width as u32,
            self.channels as u32,
            self.pixel as u32,
            columns as u32,
            rows as u32,
            self.margin() as u32,
            self.c1,
            self.c2,
        )
    }
}

/// [`PhotometricShape`] on the device.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Sizes {
    images: u32,
    height: u32,
    width: u32,
    channels: u32,
    pixel: u32,
    columns: u32,
    rows: u32,
    margin: u32,
    c1: f32,
    c2: f32,
}

/// Mean absolute difference and one minus the mean similarity, `[2]`. `shape` must fit.
pub fn photometric(client: &Client, images: Images, shape: &PhotometricShape) -> Buffer {
    measure(client, images, shape, false).0
}

/// [`photometric`], with the derivatives [3, B, D, H, W] that [`photometric_vjp`] needs.
pub fn photometric_tracked(
    client: &Client,
    images: Images,
    shape: &PhotometricShape,
) -> (Buffer, Buffer) {
    measure(client, images, shape, true)
}

fn measure(
    client: &Client,
    images: Images,
    shape: &PhotometricShape,
    keep: bool,
) -> (Buffer, Buffer) {
    let cubes = shape.cubes();
    let weights = Buffer::from_f32(client, &shape.window);
    let partials = Buffer::empty(client, 2 * cubes);
    // Without derivatives the kernel still needs a buffer to bind.
    let fields = Buffer::empty(client, if keep { FIELDS * shape.values() } else { 1 });
    let means = Buffer::empty(client, 2);
    if cubes > 0 {
        photometric_tiles::launch(
            client,
            cube_count(cubes),
            CubeDim::new_1d(UNITS as u32),
            images.rendered.arg(),
            images.target.arg(),
            weights.arg(),
            partials.arg(),
            fields.arg(),
            shape.uniforms(),
            (1.0 / shape.counted() as f64) as f32,
            shape.window.len(),
            images.kind,
            keep,
        );
    }
    means_of_tiles::launch(
        client,
        cube_count(1),
        CubeDim::new_1d(CUBE_UNITS),
        partials.arg(),
        means.arg(),
        cubes as u32,
        (1.0 / shape.values() as f64) as f32,
        (1.0 / shape.counted() as f64) as f32,
    );
    (means, fields)
}

/// Gradient of the rendered image, [B, H, W, E], from the derivatives of [`photometric_tracked`]
/// and the gradient `[2]` of its means.
pub fn photometric_vjp(
    client: &Client,
    images: Images,
    fields: &Buffer,
    grad: &Buffer,
    shape: &PhotometricShape,
) -> Buffer {
    let weights = Buffer::from_f32(client, &shape.window);
    let pixels = shape.images * shape.height * shape.width;
    let out = Buffer::empty(client, pixels * shape.pixel);
    if shape.cubes() > 0 {
        photometric_gradient::launch(
            client,
            cube_count(shape.cubes()),
            CubeDim::new_1d(UNITS as u32),
            images.rendered.arg(),
            images.target.arg(),
            fields.arg(),
            grad.arg(),
            weights.arg(),
            out.arg(),
            shape.uniforms(),
            (1.0 / shape.values() as f64) as f32,
            shape.window.len(),
            images.kind,
        );
    }
    out
}
