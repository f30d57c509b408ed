//! Blending of the tiles, front to back, and its vector-Jacobian product (3DGS section 6 and appendix C).
//!
//! Per pixel, over the splats i of its tile in depth order, d = pixel centre - mean:
//! ```text
//! z1 = w11 dx, z2 = w21 dx + w22 dy, sigma = (z1² + z2²)/2, raw = o exp(-sigma)
//! skip if raw < alpha_min;  alpha = min(alpha_max, raw);  stop before T (1 - alpha) < transmittance_min
//! image += T alpha colour;  T *= 1 - alpha;     at the end  image += T background;  A = 1 - T
//! ```
//! Backward goes back to front and recovers T by division. With g the pixel's gradient (g_A for A) and
//! `behind = T_end (background · g - g_A) + Σ of T alpha (colour · g) over the splats behind`:
//! ```text
//! dL/dcolour = T alpha g,   dL/dalpha = T (colour · g) - behind / (1 - alpha)     (0 at the cap)
//! ```
//! Gradients of one (tile, splat) pair are summed over the tile's pixels in fixed order and written to the pair's own
//! slot; then the slots of every splat are summed in order. No atomics on floats: the same bits every time.
//!
//! Any number of channels: those beyond [`MAX_CHANNELS`] go in further launches, each a chunk of them.

use cubecl::prelude::*;

use crate::exp::exp2_neg;
use crate::intersect::{Frames, Grid, IntersectError, TILE, TileLists, intersect};
use crate::launch::{Buffer, CUBE_UNITS, CUBE_UNITS_USIZE, cube_count, per_element};
use crate::math::is_finite;
use crate::project::PACKED;

/// `exp(-sigma) = 2^-t` with t this times `|z|^2`.
const HALF_LOG2_E: f32 = 0.5 * core::f32::consts::LOG2_E;

/// Channels of one launch.
pub const MAX_CHANNELS: usize = 16;

/// Floats of a splat in shared memory: mean x, y, w11, w21, w22, opacity.
const SHAPE: usize = 6;

/// Units of a tile's workgroup. Each owns [`PIXELS_PER_UNIT`] pixels below each other, [`ROWS_APART`] rows apart: what
/// it reads of a splat serves them all.
const UNITS: u32 = 64;
const UNITS_USIZE: usize = UNITS as usize;
const PIXELS_PER_UNIT: usize = (TILE * TILE / UNITS) as usize;
const ROWS_APART: u32 = UNITS / TILE;
/// Values that the units put into shared memory before they are summed: with the batch below 16 KiB together.
const MAX_ROWS: usize = 54;
/// Floats from one row of values to the next; odd, so that rows begin in different banks.
const ROW: usize = UNITS_USIZE + 1;
/// Gradients of a splat's shape and opacity in a slot, in the order of [`SHAPE`]; those of colours follow.
const SHAPE_GRADIENTS: usize = SHAPE;

/// Most gradients of one instance in one launch.
pub const MAX_SLOT_VALUES: usize = SHAPE_GRADIENTS + MAX_CHANNELS;

/// Thresholds of the blending.
#[derive(Clone, Copy, Debug)]
pub struct RasterizeSettings {
    /// Cap of alpha.
    pub alpha_max: f32,
    /// A pixel stops before its transmittance falls below this.
    pub transmittance_min: f32,
}

/// What a forward pass leaves for its backward pass.
#[derive(Clone, Debug)]
pub struct RasterizeState {
    /// The tiles' lists.
    pub lists: TileLists,
    /// Transmittance that is left of every pixel [C, H, W].
    pub transmittance: Buffer,
    /// How many splats of its tile's list every pixel has walked, the last one that contributed included [C, H, W].
    pub walked: Buffer,
}

/// Splats, and what colours them: `packed` [C, N, 9], `colors` [C, N, D], `opacities` [C, N], `background` [C, D].
#[derive(Clone, Debug)]
pub struct RasterizeInputs {
    /// Packed splats of [`crate::project`].
    pub packed: Buffer,
    /// Colours, any number of channels.
    pub colors: Buffer,
    /// Opacities.
    pub opacities: Buffer,
    /// What is behind all splats; zero if there is none.
    pub background: Option<Buffer>,
    /// D.
    pub channels: usize,
}

/// Mean, inverse Cholesky factor and opacity of a splat.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Shape {
    mean_x: f32,
    mean_y: f32,
    w11: f32,
    w21: f32,
    w22: f32,
    opacity: f32,
}

#[cube]
impl Shape {
    /// The k-th of the batch.
    fn load(shapes: &[f32], k: usize) -> Shape {
        let at = k * SHAPE;
        Shape {
            mean_x: shapes[at],
            mean_y: shapes[at + 1],
            w11: shapes[at + 2],
            w21: shapes[at + 3],
            w22: shapes[at + 4],
            opacity: shapes[at + 5],
        }
    }
}

/// A splat at a pixel.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Sample {
    dx: f32,
    dy: f32,
    z1: f32,
    z2: f32,
    /// exp(-sigma)
    falloff: f32,
    /// o exp(-sigma), not capped.
    raw: f32,
}

/// A splat at the pixel centre (x, y). Forward and backward both decide on this; fused multiply-adds are spelled out
/// so that both are rounded alike.
#[cube]
fn sample(shape: Shape, x: f32, y: f32) -> Sample {
    let dx = x - shape.mean_x;
    let dy = y - shape.mean_y;
    let z1 = shape.w11 * dx;
    let z2 = fma(shape.w21, dx, shape.w22 * dy);
    let falloff = exp2_neg(HALF_LOG2_E * fma(z2, z2, z1 * z1));
    Sample {
        dx,
        dy,
        z1,
        z2,
        falloff,
        raw: shape.opacity * falloff,
    }
}

/// The one place that decides what becomes of a (pixel, splat) pair; both passes ask it.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Thresholds {
    alpha_min: f32,
    alpha_max: f32,
    transmittance_min: f32,
}

#[cube]
impl Thresholds {
    fn seen(self, raw: f32) -> bool {
        raw >= self.alpha_min
    }

    fn alpha(self, raw: f32) -> f32 {
        min(self.alpha_max, raw)
    }

    /// At the cap alpha no longer depends on anything.
    fn capped(self, raw: f32) -> bool {
        raw >= self.alpha_max
    }

    fn stops(self, transmittance_after: f32) -> bool {
        transmittance_after < self.transmittance_min
    }
}

fn thresholds(frames: &Frames, settings: &RasterizeSettings) -> ThresholdsLaunch {
    ThresholdsLaunch::new(
        frames.alpha_min,
        settings.alpha_max,
        settings.transmittance_min,
    )
}

/// Copies the shape of `splat` to place `k` of the batch.
#[cube]
fn load_shape(packed: &[f32], opacities: &[f32], splat: usize, shapes: &mut [f32], k: usize) {
    let from = splat * PACKED;
    let to = k * SHAPE;
    shapes[to] = packed[from];
    shapes[to + 1] = packed[from + 1];
    shapes[to + 2] = packed[from + 3];
    shapes[to + 3] = packed[from + 4];
    shapes[to + 4] = packed[from + 5];
    shapes[to + 5] = opacities[splat];
}

/// One workgroup per tile; `width` channels from `first_channel` on.
#[cube(launch)]
fn rasterize_forward(
    packed: &[f32],
    colors: &[f32],
    opacities: &[f32],
    background: &[f32],
    splats: &[u32],
    ranges: &[u32],
    output: &mut [f32],
    transmittance: &mut [f32],
    walked: &mut [u32],
    grid: Grid,
    thresholds: Thresholds,
    channels: u32,
    first_channel: u32,
    #[comptime] width: usize,
    #[comptime] has_background: bool,
    #[comptime] first_launch: bool,
) {
    let mut shapes = Shared::new_slice(UNITS_USIZE * SHAPE);
    let mut ids = Shared::new_slice(UNITS_USIZE);
    let mut range = Shared::new_slice(2usize);
    let finished = Shared::<[Atomic<u32>]>::new_slice(1usize);

    let unit = UNIT_POS as usize;
    let tile = CUBE_POS as u32;
    let tiles_per_camera = grid.columns * grid.rows;
    let camera = tile / tiles_per_camera;
    let tile_in_image = tile % tiles_per_camera;
    let first_x = tile_in_image % grid.columns * TILE + UNIT_POS % TILE;
    let first_y = tile_in_image / grid.columns * TILE + UNIT_POS / TILE;
    let x = first_x as f32 + 0.5f32;

    if UNIT_POS == 0 {
        let mut start = 0u32;
        let mut end = 0u32;
        if tile < grid.tiles {
            start = ranges[tile as usize * 2];
            end = ranges[tile as usize * 2 + 1];
        }
        range[0] = start;
        range[1] = end;
        Atomic::store(&finished[0], 0u32);
    }
    let start = workgroup_uniform_load(&range[0]);
    let end = workgroup_uniform_load(&range[1]);

    let mut t = Array::<f32>::new(PIXELS_PER_UNIT);
    let mut last = Array::<u32>::new(PIXELS_PER_UNIT);
    // 1 until the pixel stops, then 0.
    let mut open = Array::<u32>::new(PIXELS_PER_UNIT);
    let mut sums = Array::<f32>::new(comptime!(PIXELS_PER_UNIT * width));
    let mut color = Array::<f32>::new(width);
    let mut open_pixels = 0u32;
    #[unroll]
    for q in 0..PIXELS_PER_UNIT {
        let inside = tile < grid.tiles
            && first_x < grid.width
            && first_y + q as u32 * ROWS_APART < grid.height;
        t[q] = 1.0f32;
        last[q] = 0u32;
        open[q] = select(inside, 1u32, 0u32);
        open_pixels += open[q];
        #[unroll]
        for channel in 0..width {
            sums[q * width + channel] = 0.0f32;
        }
    }
    if open_pixels == 0u32 {
        Atomic::fetch_add(&finished[0], 1u32);
    }
    sync_cube();

    let mut batch = start;
    while batch < end {
        // Also keeps the units together: the batch before is no longer read.
        if workgroup_uniform_load_atomic(&finished[0]) >= UNITS {
            break;
        }
        let at = batch + UNIT_POS;
        if at < end {
            let splat = splats[at as usize];
            ids[unit] = splat;
            load_shape(packed, opacities, splat as usize, &mut shapes, unit);
        }
        sync_cube();

        let was_open = open_pixels > 0u32;
        let count = min(UNITS, end - batch);
        let mut k = 0u32;
        while open_pixels > 0u32 && k < count {
            let shape = Shape::load(&shapes, k as usize);
            let from = ids[k as usize] as usize * channels as usize + first_channel as usize;
            #[unroll]
            for channel in 0..width {
                color[channel] = colors[from + channel];
            }
            #[unroll]
            for q in 0..PIXELS_PER_UNIT {
                let y = (first_y + q as u32 * ROWS_APART) as f32 + 0.5f32;
                let s = sample(shape, x, y);
                if open[q] == 1u32 && thresholds.seen(s.raw) {
                    let alpha = thresholds.alpha(s.raw);
                    let next = t[q] * (1.0f32 - alpha);
                    if thresholds.stops(next) {
                        open[q] = 0u32;
                        open_pixels -= 1u32;
                    } else {
                        let weight = alpha * t[q];
                        #[unroll]
                        for channel in 0..width {
                            sums[q * width + channel] += weight * color[channel];
                        }
                        t[q] = next;
                        last[q] = batch + k + 1u32 - start;
                    }
                }
            }
            k += 1u32;
        }
        if was_open && open_pixels == 0u32 {
            Atomic::fetch_add(&finished[0], 1u32);
        }
        batch += UNITS;
    }

    #[unroll]
    for q in 0..PIXELS_PER_UNIT {
        let pixel_y = first_y + q as u32 * ROWS_APART;
        if tile < grid.tiles && first_x < grid.width && pixel_y < grid.height {
            let pixel = ((camera * grid.height + pixel_y) * grid.width + first_x) as usize;
            let out = pixel * (channels as usize + 1) + first_channel as usize;
            #[unroll]
            for channel in 0..width {
                let mut sum = sums[q * width + channel];
                if comptime!(has_background) {
                    sum +=
                        t[q] * background[(camera * channels + first_channel) as usize + channel];
                }
                output[out + channel] = sum;
            }
            if comptime!(first_launch) {
                output[out + channels as usize] = 1.0f32 - t[q];
                transmittance[pixel] = t[q];
                walked[pixel] = last[q];
            }
        }
    }
}

/// The opacity of every splat, zero where a colour is not finite: it is then in no list, and nothing reads it.
#[cube(launch)]
fn hide_broken_colors(
    colors: &[f32],
    opacities: &[f32],
    out: &mut [f32],
    splats: u32,
    channels: u32,
) {
    let splat = ABSOLUTE_POS;
    if splat < splats as usize {
        let mut opacity = opacities[splat];
        for channel in 0..channels as usize {
            if !is_finite(colors[splat * channels as usize + channel]) {
                opacity = 0.0f32;
            }
        }
        out[splat] = opacity;
    }
}

fn without_broken_colors(client: &Client, inputs: &RasterizeInputs, frames: &Frames) -> Buffer {
    let out = Buffer::empty(client, frames.splats());
    if let Some((count, dim)) = per_element(frames.splats()) {
        hide_broken_colors::launch(
            client,
            count,
            dim,
            inputs.colors.arg(),
            inputs.opacities.arg(),
            out.arg(),
            frames.splats() as u32,
            inputs.channels as u32,
        );
    }
    out
}

/// Renders all cameras: the image with alpha as its last channel [C, H, W, D + 1], and what the backward pass needs.
/// Waits for the device once, to learn the number of instances.
///
/// # Errors
/// Those of [`intersect`].
pub fn rasterize(
    client: &Client,
    inputs: &RasterizeInputs,
    frames: &Frames,
    settings: &RasterizeSettings,
) -> Result<(Buffer, RasterizeState), IntersectError> {
    let opacities = without_broken_colors(client, inputs, frames);
    let lists = intersect(client, &inputs.packed, &opacities, frames)?;
    let pixels = frames.cameras * frames.width as usize * frames.height as usize;
    let output = Buffer::empty(client, pixels * (inputs.channels + 1));
    let transmittance = Buffer::empty(client, pixels);
    let walked = Buffer::empty(client, pixels);
    let background = inputs.background.clone();
    let background = background.unwrap_or_else(|| Buffer::empty(client, 1));
    for first_channel in (0..inputs.channels).step_by(MAX_CHANNELS) {
        rasterize_forward::launch(
            client,
            cube_count(frames.tiles()),
            CubeDim::new_1d(UNITS),
            inputs.packed.arg(),
            inputs.colors.arg(),
            inputs.opacities.arg(),
            background.arg(),
            lists.splats.arg(),
            lists.ranges.arg(),
            output.arg(),
            transmittance.arg(),
            walked.arg(),
            frames.uniforms(),
            thresholds(frames, settings),
            inputs.channels as u32,
            first_channel as u32,
            MAX_CHANNELS.min(inputs.channels - first_channel),
            inputs.background.is_some(),
            first_channel == 0,
        );
    }
    let state = RasterizeState {
        lists,
        transmittance,
        walked,
    };
    Ok((output, state))
}

/// Which values a launch of the backward pass sums, and how many there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct SlotLayout {
    /// Gradients of shape and opacity, [`SHAPE_GRADIENTS`] of them, come first.
    shape: bool,
    /// Then those of the colours.
    colors: bool,
    /// Channels of this launch.
    width: usize,
}

impl SlotLayout {
    fn values(self) -> usize {
        self.first_color() + if self.colors { self.width } else { 0 }
    }

    fn first_color(self) -> usize {
        if self.shape { SHAPE_GRADIENTS } else { 0 }
    }

    /// Splats whose values are in shared memory at once.
    fn group(self) -> usize {
        (MAX_ROWS / self.values()).clamp(1, 8)
    }
}

/// Gradients of every (tile, splat) pair, to the pair's slot: one workgroup per tile, back to front.
#[cube(launch)]
fn rasterize_backward(
    packed: &[f32],
    colors: &[f32],
    opacities: &[f32],
    background: &[f32],
    splats: &[u32],
    slots: &[u32],
    ranges: &[u32],
    transmittance: &[f32],
    walked: &[u32],
    grad_output: &[f32],
    slot_gradients: &mut [f32],
    grid: Grid,
    thresholds: Thresholds,
    channels: u32,
    first_channel: u32,
    #[comptime] layout: SlotLayout,
    #[comptime] has_background: bool,
    #[comptime] first_launch: bool,
) {
    let values = comptime!(layout.values());
    let group = comptime!(layout.group());
    let width = comptime!(layout.width);

    let mut shapes = Shared::new_slice(UNITS_USIZE * SHAPE);
    let mut ids = Shared::new_slice(UNITS_USIZE);
    let mut batch_slots = Shared::new_slice(UNITS_USIZE);
    let mut rows = Shared::new_slice(comptime!(group * values * ROW));
    let mut start = Shared::new_slice(1usize);
    let longest = Shared::<[Atomic<u32>]>::new_slice(1usize);

    let unit = UNIT_POS as usize;
    let tile = CUBE_POS as u32;
    let tiles_per_camera = grid.columns * grid.rows;
    let camera = tile / tiles_per_camera;
    let tile_in_image = tile % tiles_per_camera;
    let first_x = tile_in_image % grid.columns * TILE + UNIT_POS % TILE;
    let first_y = tile_in_image / grid.columns * TILE + UNIT_POS / TILE;
    let x = first_x as f32 + 0.5f32;

    if UNIT_POS == 0 {
        let mut first = 0u32;
        if tile < grid.tiles {
            first = ranges[tile as usize * 2];
        }
        start[0] = first;
        Atomic::store(&longest[0], 0u32);
    }
    sync_cube();

    let mut t = Array::<f32>::new(PIXELS_PER_UNIT);
    let mut behind = Array::<f32>::new(PIXELS_PER_UNIT);
    let mut last = Array::<u32>::new(PIXELS_PER_UNIT);
    let mut g = Array::<f32>::new(comptime!(PIXELS_PER_UNIT * width));
    let mut color = Array::<f32>::new(width);
    #[unroll]
    for q in 0..PIXELS_PER_UNIT {
        let pixel_y = first_y + q as u32 * ROWS_APART;
        t[q] = 1.0f32;
        behind[q] = 0.0f32;
        last[q] = 0u32;
        #[unroll]
        for channel in 0..width {
            g[q * width + channel] = 0.0f32;
        }
        if tile < grid.tiles && first_x < grid.width && pixel_y < grid.height {
            let pixel = ((camera * grid.height + pixel_y) * grid.width + first_x) as usize;
            let from = pixel * (channels as usize + 1) + first_channel as usize;
            let end = transmittance[pixel];
            t[q] = end;
            last[q] = walked[pixel];
            let mut seen = 0.0f32;
            #[unroll]
            for channel in 0..width {
                let value = grad_output[from + channel];
                g[q * width + channel] = value;
                if comptime!(has_background) {
                    seen +=
                        value * background[(camera * channels + first_channel) as usize + channel];
                }
            }
            if comptime!(first_launch) {
                seen -= grad_output[from + channels as usize];
            }
            behind[q] = end * seen;
            Atomic::fetch_max(&longest[0], last[q]);
        }
    }
    sync_cube();
    let start = workgroup_uniform_load(&start[0]);
    let mut remaining = workgroup_uniform_load_atomic(&longest[0]);

    // Batches from the back; place k of a batch holds entry remaining - 1 - k.
    while remaining > 0u32 {
        let count = min(UNITS, remaining);
        sync_cube();
        if UNIT_POS < count {
            let at = (start + remaining - 1u32 - UNIT_POS) as usize;
            let splat = splats[at];
            ids[unit] = splat;
            batch_slots[unit] = slots[at];
            load_shape(packed, opacities, splat as usize, &mut shapes, unit);
        }
        sync_cube();

        let mut from = 0u32;
        while from < count {
            for place in 0..group {
                let k = from as usize + place;
                let mut sums = Array::<f32>::new(values);
                #[unroll]
                for value in 0..values {
                    sums[value] = 0.0f32;
                }
                if k < count as usize {
                    let entry = remaining - 1u32 - k as u32;
                    let shape = Shape::load(&shapes, k);
                    let at = ids[k] as usize * channels as usize + first_channel as usize;
                    #[unroll]
                    for channel in 0..width {
                        color[channel] = colors[at + channel];
                    }
                    #[unroll]
                    for q in 0..PIXELS_PER_UNIT {
                        if entry < last[q] {
                            let y = (first_y + q as u32 * ROWS_APART) as f32 + 0.5f32;
                            let s = sample(shape, x, y);
                            if thresholds.seen(s.raw) {
                                let alpha = thresholds.alpha(s.raw);
                                let clear = 1.0f32 - alpha;
                                let before = t[q] / clear;
                                let weight = alpha * before;
                                let mut dot = 0.0f32;
                                #[unroll]
                                for channel in 0..width {
                                    let value = g[q * width + channel];
                                    dot += color[channel] * value;
                                    if comptime!(layout.colors) {
                                        sums[comptime!(layout.first_color()) + channel] +=
                                            weight * value;
                                    }
                                }
                                if comptime!(layout.shape) {
                                    if !thresholds.capped(s.raw) {
                                        let g_alpha = before * dot - behind[q] / clear;
                                        let g_sigma = -g_alpha * s.raw;
                                        let g_z1 = g_sigma * s.z1;
                                        let g_z2 = g_sigma * s.z2;
                                        // d = pixel - mean
                                        sums[0] -= g_z1 * shape.w11 + g_z2 * shape.w21;
                                        sums[1] -= g_z2 * shape.w22;
                                        sums[2] += g_z1 * s.dx;
                                        sums[3] += g_z2 * s.dx;
                                        sums[4] += g_z2 * s.dy;
                                        sums[5] += g_alpha * s.falloff;
                                    }
                                }
                                behind[q] += weight * dot;
                                t[q] = before;
                            }
                        }
                    }
                }
                #[unroll]
                for value in 0..values {
                    rows[(place * values + value) * ROW + unit] = sums[value];
                }
            }
            sync_cube();
            // One unit sums one row: the row's splat is place unit / values of the group.
            let k = from as usize + unit / values;
            if unit < comptime!(group * values) && k < count as usize {
                let mut sum = 0.0f32;
                for other in 0..UNITS_USIZE {
                    sum += rows[unit * ROW + other];
                }
                slot_gradients[batch_slots[k] as usize * values + unit % values] = sum;
            }
            sync_cube();
            from += group as u32;
        }
        remaining -= count;
    }
}

/// Sums the slots of every splat in order, and spreads them over the gradients. One unit per (splat, value).
#[cube(launch)]
fn sum_slots(
    slot_gradients: &[f32],
    order: &[u32],
    offsets: &[u32],
    grad_packed: &mut [f32],
    grad_colors: &mut [f32],
    grad_opacities: &mut [f32],
    splats: u32,
    channels: u32,
    first_channel: u32,
    #[comptime] layout: SlotLayout,
    #[comptime] first_launch: bool,
) {
    let values = comptime!(layout.values());
    let j = ABSOLUTE_POS / values;
    let value = ABSOLUTE_POS % values;
    if j < splats as usize {
        let splat = order[j] as usize;
        let mut sum = 0.0f32;
        for slot in offsets[j]..offsets[j + 1] {
            sum += slot_gradients[slot as usize * values + value];
        }
        if value >= comptime!(layout.first_color()) {
            let channel = first_channel as usize + value - comptime!(layout.first_color());
            if comptime!(layout.colors) {
                grad_colors[splat * channels as usize + channel] = sum;
            }
        } else if comptime!(layout.shape) {
            // Shape: mean x, y are entries 0, 1 of a packed splat; w11, w21, w22 are 3, 4, 5.
            let at = splat * PACKED + select(value < 2, value, value + 1);
            if comptime!(first_launch) {
                if value == 5 {
                    grad_opacities[splat] = sum;
                } else {
                    grad_packed[at] = sum;
                }
                if value < 4 {
                    // The entries without gradient: depth, compensation, extents.
                    grad_packed[splat * PACKED + select(value == 0, 2usize, value + 5)] = 0.0f32;
                }
            } else if value == 5 {
                grad_opacities[splat] += sum;
            } else {
                grad_packed[at] += sum;
            }
        }
    }
}

#[cube(launch)]
fn fill_zero(buffer: &mut [f32], len: u32) {
    if ABSOLUTE_POS < len as usize {
        buffer[ABSOLUTE_POS] = 0.0f32;
    }
}

fn zeros(client: &Client, len: usize) -> Buffer {
    let buffer = Buffer::empty(client, len);
    if let Some((count, dim)) = per_element(len) {
        fill_zero::launch(client, count, dim, buffer.arg(), len as u32);
    }
    buffer
}

/// Pixels of one unit of the background's gradient.
const BACKGROUND_ITEMS: usize = 16;
const BACKGROUND_BLOCK: usize = CUBE_UNITS_USIZE * BACKGROUND_ITEMS;

/// `partials[camera, block, channel]` = Σ over the block's pixels of T_end g.
#[cube(launch)]
fn background_partials(
    transmittance: &[f32],
    grad_output: &[f32],
    partials: &mut [f32],
    pixels: u32,
    cameras: u32,
    blocks: u32,
    channels: u32,
) {
    let mut shared = Shared::new_slice(CUBE_UNITS_USIZE);
    let unit = UNIT_POS as usize;
    let camera = CUBE_POS / blocks as usize;
    let block = CUBE_POS % blocks as usize;
    for channel in 0..channels as usize {
        let mut sum = 0.0f32;
        if camera < cameras as usize {
            for item in 0..BACKGROUND_ITEMS {
                let pixel = block * BACKGROUND_BLOCK + item * CUBE_UNITS_USIZE + unit;
                if pixel < pixels as usize {
                    let at = camera * pixels as usize + pixel;
                    sum += transmittance[at] * grad_output[at * (channels as usize + 1) + channel];
                }
            }
        }
        shared[unit] = sum;
        sync_cube();
        let mut half = (CUBE_UNITS_USIZE / 2).runtime();
        while half > 0 {
            if unit < half {
                let other = shared[unit + half];
                shared[unit] += other;
            }
            sync_cube();
            half /= 2;
        }
        if unit == 0 && camera < cameras as usize {
            partials[CUBE_POS * channels as usize + channel] = shared[0];
        }
        sync_cube();
    }
}

/// `out[camera, channel]` = Σ over blocks, in order.
#[cube(launch)]
fn sum_background_partials(
    partials: &[f32],
    out: &mut [f32],
    cameras: u32,
    blocks: u32,
    channels: u32,
) {
    let camera = ABSOLUTE_POS as u32 / channels;
    let channel = ABSOLUTE_POS as u32 % channels;
    if camera < cameras {
        let mut sum = 0.0f32;
        for block in 0..blocks {
            sum += partials[((camera * blocks + block) * channels + channel) as usize];
        }
        out[ABSOLUTE_POS] = sum;
    }
}

fn background_gradient(
    client: &Client,
    state: &RasterizeState,
    grad_output: &Buffer,
    channels: usize,
    frames: &Frames,
) -> Buffer {
    let pixels = frames.width as usize * frames.height as usize;
    let blocks = pixels.div_ceil(BACKGROUND_BLOCK);
    let partials = Buffer::empty(client, frames.cameras * blocks * channels);
    let out = Buffer::empty(client, frames.cameras * channels);
    if let Some((count, dim)) = per_element(out.len()) {
        background_partials::launch(
            client,
            cube_count(frames.cameras * blocks),
            CubeDim::new_1d(CUBE_UNITS),
            state.transmittance.arg(),
            grad_output.arg(),
            partials.arg(),
            pixels as u32,
            frames.cameras as u32,
            blocks as u32,
            channels as u32,
        );
        sum_background_partials::launch(
            client,
            count,
            dim,
            partials.arg(),
            out.arg(),
            frames.cameras as u32,
            blocks as u32,
            channels as u32,
        );
    }
    out
}

/// Gradients of packed splats [C, N, 9], colours [C, N, D], opacities [C, N] and background [C, D] for the gradient of
/// the output [C, H, W, D + 1]; only those `wanted`.
pub fn rasterize_vjp(
    client: &Client,
    inputs: &RasterizeInputs,
    state: &RasterizeState,
    grad_output: &Buffer,
    frames: &Frames,
    settings: &RasterizeSettings,
    wanted: [bool; 4],
) -> [Option<Buffer>; 4] {
    let splats = frames.splats();
    let channels = inputs.channels;
    let [
        wants_packed,
        wants_colors,
        wants_opacities,
        wants_background,
    ] = wanted;
    let shape = wants_packed || wants_opacities;
    let reserve = |needed: bool, len: usize| Buffer::empty(client, if needed { len } else { 1 });
    let grad_packed = reserve(shape, splats * PACKED);
    let grad_colors = reserve(wants_colors, splats * channels);
    let grad_opacities = reserve(shape, splats);
    let lists = &state.lists;

    if shape || wants_colors {
        let background = inputs.background.clone();
        let background = background.unwrap_or_else(|| Buffer::empty(client, 1));
        for first_channel in (0..channels).step_by(MAX_CHANNELS) {
            let layout = SlotLayout {
                shape,
                colors: wants_colors,
                width: MAX_CHANNELS.min(channels - first_channel),
            };
            let slot_gradients = zeros(client, lists.instances * layout.values());
            if lists.instances > 0 {
                rasterize_backward::launch(
                    client,
                    cube_count(frames.tiles()),
                    CubeDim::new_1d(UNITS),
                    inputs.packed.arg(),
                    inputs.colors.arg(),
                    inputs.opacities.arg(),
                    background.arg(),
                    lists.splats.arg(),
                    lists.slots.arg(),
                    lists.ranges.arg(),
                    state.transmittance.arg(),
                    state.walked.arg(),
                    grad_output.arg(),
                    slot_gradients.arg(),
                    frames.uniforms(),
                    thresholds(frames, settings),
                    channels as u32,
                    first_channel as u32,
                    layout,
                    inputs.background.is_some(),
                    first_channel == 0,
                );
            }
            if let Some((count, dim)) = per_element(splats * layout.values()) {
                sum_slots::launch(
                    client,
                    count,
                    dim,
                    slot_gradients.arg(),
                    lists.order.arg(),
                    lists.offsets.arg(),
                    grad_packed.arg(),
                    grad_colors.arg(),
                    grad_opacities.arg(),
                    splats as u32,
                    channels as u32,
                    first_channel as u32,
                    layout,
                    first_channel == 0,
                );
            }
        }
    }
    [
        wants_packed.then_some(grad_packed),
        wants_colors.then_some(grad_colors),
        wants_opacities.then_some(grad_opacities),
        (wants_background && inputs.background.is_some())
            .then(|| background_gradient(client, state, grad_output, channels, frames)),
    ]
}
