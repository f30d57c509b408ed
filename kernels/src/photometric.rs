//! Mean absolute difference and mean structural similarity of a rendered image and a photo, in one launch and one that
//! adds its sums; the gradient in one more. S and its derivatives are those of [`crate::ssim`].
//!
//! A workgroup has a tile of one channel. It windows the rows into shared memory, a unit making eight neighbouring values
//! of each moment, and then the columns from there. What the gradient needs is kept, of each value three: weight times
//! dS/dmx, dS/dq and dS/dp, channel by channel. The weight is one over the number of values that count, and zero for a
//! value that does not.
//!
//! Floor per pixel and channel. Forward: 4 bytes read and 1 of an 8-bit photo, or 4 of another; 12 written to be kept;
//! 2 x 4 x 11 fused multiply-adds with the window of 11. Gradient: 12 read, and both images again, 4 written; 2 x 3 x 11
//! fused multiply-adds. Values under the window but outside of the tile are read by its neighbours too, rows of them
//! windowed twice: 26 rows for 16.

use cubecl::prelude::*;

use crate::floor::{self, Bytes};
use crate::launch::{Buffer, CUBE_UNITS, CUBE_UNITS_USIZE, cube_count};
use crate::reduce::sum_units;
use crate::ssim::{RUN, UNROLLED_TAPS, load_window, terms, windowed};

/// Pixels of a tile.
const TILE_WIDTH: usize = 32;
const TILE_HEIGHT: usize = 16;
/// Floats from a row in shared memory to the next: one more than there are, so that the runs of several rows are in
/// different banks.
const PITCH: usize = TILE_WIDTH + 1;
/// Runs along a row of a tile.
const RUNS: usize = TILE_WIDTH / RUN;
/// Units of a workgroup: one makes a run down a column.
const UNITS: usize = TILE_WIDTH * TILE_HEIGHT / RUN;
/// mx, my, q, p.
const MOMENTS: usize = 4;
/// Derivatives by mx, q, p.
const FIELDS: usize = 3;

/// What the loss of one view and its gradient must move; the photo is of 8 bits.
pub(crate) fn floor(sizes: &floor::Sizes) -> [Bytes; 2] {
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

/// How a photo lies in memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum TargetKind {
    /// Values, 32-bit floats.
    Values,
    /// Levels, 255 for the value 1, 32-bit integers.
    Words,
    /// Levels, four of 8 bits in a word, the first in its lowest.
    Bytes,
}

/// Both images: what was rendered, [B, H, W, E], and the photo, [B, H, W, D].
#[derive(Clone, Copy, Debug)]
pub struct Images<'a> {
    /// f32.
    pub rendered: &'a Buffer,
    /// As `kind` says.
    pub target: &'a Buffer,
    /// What `target` holds.
    pub kind: TargetKind,
}

/// Sizes, constants and the window.
#[derive(Clone, Debug)]
pub struct PhotometricShape {
    /// B, images.
    pub images: usize,
    /// Pixels.
    pub height: usize,
    /// Pixels.
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
    /// Whether tiles of moments under this window fit into the shared memory of a workgroup.
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

    /// How far from the image's edges a pixel counts for the mean similarity: that of a window that reaches over them
    /// does not, unless all do.
    fn margin(&self) -> usize {
        let taps = self.window.len();
        if self.height < taps || self.width < taps {
            0
        } else {
            taps / 2
        }
    }

    /// Values that count.
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

/// The tile and channel of a workgroup.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Place {
    /// There may be more workgroups than work.
    exists: bool,
    image: u32,
    channel: u32,
    /// First pixel.
    x: u32,
    y: u32,
}

#[cube]
impl Place {
    /// Channels of a tile lie beside each other, so that they find its pixels in the cache.
    fn new(sizes: Sizes) -> Place {
        let cube = CUBE_POS as u32;
        let tile = cube / sizes.channels;
        let row = tile / sizes.columns;
        let image = row / sizes.rows;
        Place {
            exists: image < sizes.images,
            image,
            channel: cube % sizes.channels,
            x: tile % sizes.columns * TILE_WIDTH as u32,
            y: row % sizes.rows * TILE_HEIGHT as u32,
        }
    }

    /// Whether a pixel is in the image, and its index over all images; that of some other pixel if not. Its place may be
    /// shifted by `back` to the left and up, beyond the edge.
    fn pixel(self, sizes: Sizes, x: u32, y: u32, back: u32) -> (bool, usize) {
        let inside = self.exists
            && x >= back
            && y >= back
            && x - back < sizes.width
            && y - back < sizes.height;
        let index = (self.image * sizes.height + y - back) * sizes.width + x - back;
        (inside, select(inside, index, 0u32) as usize)
    }
}

/// Value `index` of the photo.
#[cube]
fn target_value(target: &[u32], index: usize, #[comptime] kind: TargetKind) -> f32 {
    if comptime!(kind == TargetKind::Values) {
        f32::reinterpret(target[index])
    } else if comptime!(kind == TargetKind::Words) {
        i32::reinterpret(target[index]) as f32 / 255.0f32
    } else {
        let shift = (index % 4) as u32 * 8u32;
        ((target[index / 4] >> shift) & 0xffu32) as f32 / 255.0f32
    }
}

/// Puts a run along row `row` of a field into shared memory.
#[cube]
fn put(
    shared: &mut Shared<[f32]>,
    sums: &Array<f32>,
    field: usize,
    row: usize,
    run: usize,
    #[comptime] taps: usize,
) {
    let to = (field * comptime!(TILE_HEIGHT + taps - 1) + row) * PITCH + run * RUN;
    #[unroll]
    for o in 0..RUN {
        shared[to + o] = sums[o];
    }
}

/// The run of the unit, windowed down its column of a field.
#[cube]
fn down_column(
    shared: &Shared<[f32]>,
    field: usize,
    window: &Array<f32>,
    sums: &mut Array<f32>,
    #[comptime] taps: usize,
) {
    let unrolled = comptime!(taps <= UNROLLED_TAPS);
    let span = comptime!(RUN + taps - 1);
    let first = UNIT_POS as usize / TILE_WIDTH * RUN;
    let from = (field * comptime!(TILE_HEIGHT + taps - 1) + first) * PITCH
        + UNIT_POS as usize % TILE_WIDTH;
    let mut values = Array::<f32>::new(span);
    #[unroll(unrolled)]
    for i in 0..span {
        values[i] = shared[from + i * PITCH];
    }
    windowed(&values, window, sums, taps, unrolled);
}

/// Sums of |x - y| and of S over a tile, to `partials[workgroup, 2]`; if `keep`, the derivatives too.
#[cube(launch)]
fn photometric_tiles(
    rendered: &[f32],
    target: &[u32],
    weights: &[f32],
    partials: &mut [f32],
    fields: &mut [f32],
    sizes: Sizes,
    weight: f32,
    #[comptime] taps: usize,
    #[comptime] kind: TargetKind,
    #[comptime] keep: bool,
) {
    let unrolled = comptime!(taps <= UNROLLED_TAPS);
    let span = comptime!(RUN + taps - 1);
    let rows = comptime!(TILE_HEIGHT + taps - 1);
    let mut shared = Shared::new_slice(comptime!(MOMENTS * rows * PITCH));
    let mut summed = Shared::new_slice(UNITS);
    let place = Place::new(sizes);
    let window = load_window(weights, taps, unrolled);
    let pixel = sizes.pixel as usize;
    let channels = sizes.channels as usize;
    let channel = place.channel as usize;
    let mut sums = Array::<f32>::new(RUN);

    let mut task = UNIT_POS as usize;
    while task < comptime!(rows * RUNS) {
        let row = task / RUNS;
        let run = task % RUNS;
        let mut xs = Array::<f32>::new(span);
        let mut ys = Array::<f32>::new(span);
        let mut products = Array::<f32>::new(span);
        #[unroll(unrolled)]
        for i in 0..span {
            let x = place.x + (run * RUN + i) as u32;
            let y = place.y + row as u32;
            let (inside, at) = place.pixel(sizes, x, y, comptime!((taps / 2) as u32));
            xs[i] = select(inside, rendered[at * pixel + channel], 0.0f32);
            let value = target_value(target, at * channels + channel, kind);
            ys[i] = select(inside, value, 0.0f32);
        }
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
            put(&mut shared, &sums, field, row, run, taps);
        }
        task += UNITS;
    }
    sync_cube();

    let mut mx = Array::<f32>::new(RUN);
    let mut my = Array::<f32>::new(RUN);
    let mut q = Array::<f32>::new(RUN);
    let mut p = Array::<f32>::new(RUN);
    down_column(&shared, 0usize, &window, &mut mx, taps);
    down_column(&shared, 1usize, &window, &mut my, taps);
    down_column(&shared, 2usize, &window, &mut q, taps);
    down_column(&shared, 3usize, &window, &mut p, taps);
    let x = place.x + UNIT_POS % TILE_WIDTH as u32;
    let first = place.y + UNIT_POS / TILE_WIDTH as u32 * RUN as u32;
    let mut difference = 0.0f32;
    let mut similarity = 0.0f32;
    #[unroll]
    for o in 0..RUN {
        let y = first + o as u32;
        let (inside, at) = place.pixel(sizes, x, y, 0u32);
        if inside {
            let value = target_value(target, at * channels + channel, kind);
            difference += f32::abs(rendered[at * pixel + channel] - value);
            let counts = x >= sizes.margin
                && y >= sizes.margin
                && x + sizes.margin < sizes.width
                && y + sizes.margin < sizes.height;
            let t = terms(mx[o], my[o], q[o], p[o], sizes.c1, sizes.c2);
            let scale = 1.0f32 / (t.b * t.d);
            let s = t.a * t.c * scale;
            similarity += select(counts, s, 0.0f32);
            if comptime!(keep) {
                let g = select(counts, weight, 0.0f32);
                let slope = 1.0f32 / t.d - 1.0f32 / t.b;
                let plane = (place.image * sizes.channels + place.channel) * sizes.height;
                let to = ((plane + y) * sizes.width + x) as usize;
                let len = fields.len() / FIELDS;
                fields[to] = g * 2.0f32 * (my[o] * (t.c - t.a) * scale + mx[o] * s * slope);
                fields[len + to] = -g * s / t.d;
                fields[2 * len + to] = g * 2.0f32 * t.a * scale;
            }
        }
    }
    let difference = sum_units(&mut summed, difference, UNITS);
    let similarity = sum_units(&mut summed, similarity, UNITS);
    if UNIT_POS == 0 && place.exists {
        partials[CUBE_POS * 2] = difference;
        partials[CUBE_POS * 2 + 1] = similarity;
    }
}

/// Both sums over the tiles, in order, times what makes them means. One workgroup.
#[cube(launch)]
fn means_of_tiles(partials: &[f32], means: &mut [f32], tiles: u32, l1: f32, ssim: f32) {
    let mut shared = Shared::new_slice(CUBE_UNITS_USIZE);
    let mut difference = 0.0f32;
    let mut similarity = 0.0f32;
    let mut tile = UNIT_POS as usize;
    while tile < tiles as usize {
        difference += partials[tile * 2];
        similarity += partials[tile * 2 + 1];
        tile += CUBE_UNITS_USIZE;
    }
    let difference = sum_units(&mut shared, difference, CUBE_UNITS_USIZE);
    let similarity = sum_units(&mut shared, similarity, CUBE_UNITS_USIZE);
    if UNIT_POS == 0 {
        means[0] = difference * l1;
        means[1] = 1.0f32 - similarity * ssim;
    }
}

/// Mean absolute difference, and one less the mean similarity: `[2]`. `shape` must fit.
pub fn photometric(client: &Client, images: Images, shape: &PhotometricShape) -> Buffer {
    measure(client, images, shape, false).0
}

/// The same, and the derivatives [3, B, D, H, W] that [`photometric_vjp`] needs.
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
    // Without derivatives there still is something to bind.
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

/// The derivatives, windowed, put together with the sign of x - y: the gradient of x; zero for the channels beyond the
/// photo's.
#[cube(launch)]
fn photometric_gradient(
    rendered: &[f32],
    target: &[u32],
    fields: &[f32],
    grad: &[f32],
    weights: &[f32],
    out: &mut [f32],
    sizes: Sizes,
    weight: f32,
    #[comptime] taps: usize,
    #[comptime] kind: TargetKind,
) {
    let unrolled = comptime!(taps <= UNROLLED_TAPS);
    let span = comptime!(RUN + taps - 1);
    let rows = comptime!(TILE_HEIGHT + taps - 1);
    let mut shared = Shared::new_slice(comptime!(FIELDS * rows * PITCH));
    let place = Place::new(sizes);
    let window = load_window(weights, taps, unrolled);
    let pixel = sizes.pixel as usize;
    let channels = sizes.channels as usize;
    let channel = place.channel as usize;
    let mut sums = Array::<f32>::new(RUN);

    // Fields lie channel by channel: a plane is an image of one channel.
    let planes = Place {
        exists: place.exists,
        image: place.image * sizes.channels + place.channel,
        channel: 0u32,
        x: place.x,
        y: place.y,
    };
    let len = fields.len() / FIELDS;
    let mut task = UNIT_POS as usize;
    while task < comptime!(rows * RUNS) {
        let row = task / RUNS;
        let run = task % RUNS;
        let mut values = Array::<f32>::new(span);
        #[unroll]
        for field in 0..FIELDS {
            #[unroll(unrolled)]
            for i in 0..span {
                let x = place.x + (run * RUN + i) as u32;
                let y = place.y + row as u32;
                let (inside, at) = planes.pixel(sizes, x, y, comptime!((taps / 2) as u32));
                values[i] = select(inside, fields[field * len + at], 0.0f32);
            }
            windowed(&values, &window, &mut sums, taps, unrolled);
            put(&mut shared, &sums, field, row, run, taps);
        }
        task += UNITS;
    }
    sync_cube();

    let mut by_mean = Array::<f32>::new(RUN);
    let mut by_squares = Array::<f32>::new(RUN);
    let mut by_product = Array::<f32>::new(RUN);
    down_column(&shared, 0usize, &window, &mut by_mean, taps);
    down_column(&shared, 1usize, &window, &mut by_squares, taps);
    down_column(&shared, 2usize, &window, &mut by_product, taps);
    let l1 = grad[0] * weight;
    let ssim = -grad[1];
    let x = place.x + UNIT_POS % TILE_WIDTH as u32;
    let first = place.y + UNIT_POS / TILE_WIDTH as u32 * RUN as u32;
    #[unroll]
    for o in 0..RUN {
        let (inside, at) = place.pixel(sizes, x, first + o as u32, 0u32);
        if inside {
            let own = rendered[at * pixel + channel];
            let other = target_value(target, at * channels + channel, kind);
            let slope = by_mean[o] + 2.0f32 * own * by_squares[o] + other * by_product[o];
            let below = select(own < other, -l1, 0.0f32);
            out[at * pixel + channel] = select(own > other, l1, below) + slope * ssim;
            if channel + 1 == channels {
                for rest in channels..pixel {
                    out[at * pixel + rest] = 0.0f32;
                }
            }
        }
    }
}

/// Gradient of what was rendered, [B, H, W, E], given what [`photometric_tracked`] kept and the gradient `[2]` of its
/// means.
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
