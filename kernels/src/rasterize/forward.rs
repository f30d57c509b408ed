//! Blending of a tile, front to back.
//!
//! Floor per (block, splat) pair: 24 bytes of shape and 4 per channel from shared memory; per pixel
//! of the block about 30 operations and 2 per channel. Per intersection: 28 bytes and 4 per channel
//! from memory; per pixel 12 bytes and 4 per channel to memory.

use cubecl::prelude::*;

use super::pair::{SHAPE, Shape, Thresholds, UNSEEN, sample};
use super::tile::{BATCH, Batch, Place, Plan, WORDS, pixel_index, place};
use crate::intersect::Grid;

/// The pixels of a unit.
#[derive(CubeType)]
struct Pixels {
    /// Transmittance.
    t: Array<f32>,
    /// Entry behind the last splat that was blended; counting, how many were.
    last: Array<u32>,
    /// 1 until the pixel stops, then 0.
    open: Array<u32>,
    /// Blended colours, channel by channel of each pixel.
    sums: Array<f32>,
    /// Counting: splats that were tested, and those past the alpha cut.
    tested: Array<u32>,
    cut: Array<u32>,
}

#[cube]
impl Pixels {
    fn new(grid: Grid, place: Place, #[comptime] plan: Plan, #[comptime] width: usize) -> Pixels {
        let pixels = comptime!(plan.pixels());
        let mut t = Array::<f32>::new(pixels);
        let mut last = Array::<u32>::new(pixels);
        let mut open = Array::<u32>::new(pixels);
        let mut sums = Array::<f32>::new(comptime!(pixels * width));
        let mut tested = Array::<u32>::new(pixels);
        let mut cut = Array::<u32>::new(pixels);
        #[unroll]
        for q in 0..pixels {
            let (x, y) = place.pixel(q, plan);
            let (inside, _index) = pixel_index(grid, place, x, y);
            t[q] = 1.0f32;
            last[q] = 0u32;
            tested[q] = 0u32;
            cut[q] = 0u32;
            open[q] = select(inside, 1u32, 0u32);
            #[unroll]
            for channel in 0..width {
                sums[q * width + channel] = 0.0f32;
            }
        }
        Pixels {
            t,
            last,
            open,
            sums,
            tested,
            cut,
        }
    }

    /// How many have not stopped.
    fn count_open(&self, #[comptime] plan: Plan) -> u32 {
        let mut count = 0u32;
        #[unroll]
        for q in 0..comptime!(plan.pixels()) {
            count += self.open[q];
        }
        count
    }

    /// Blends the splat that begins at `at`, whose place in the list is followed by `next_entry`.
    fn blend(
        &mut self,
        splats: &Shared<[f32]>,
        at: usize,
        next_entry: u32,
        place: Place,
        thresholds: Thresholds,
        #[comptime] plan: Plan,
        #[comptime] width: usize,
        #[comptime] counting: bool,
    ) {
        let shape = Shape::load(splats, at);
        let mut color = Array::<f32>::new(width);
        #[unroll]
        for channel in 0..width {
            color[channel] = splats[at + SHAPE + channel];
        }
        #[unroll]
        for q in 0..comptime!(plan.pixels()) {
            let (x, y) = place.pixel(q, plan);
            let s = sample(shape, x as f32 + 0.5f32, y as f32 + 0.5f32);
            let raw = select(self.open[q] == 1u32, s.raw, UNSEEN);
            let seen = thresholds.seen(raw);
            let alpha = thresholds.alpha(raw);
            let next = self.t[q] * (1.0f32 - alpha);
            // The pixel stops before a splat that would leave too little light.
            let left = select(thresholds.stops(next), 0u32, 1u32);
            let blended = select(seen, left, 0u32);
            if comptime!(counting) {
                self.tested[q] += self.open[q];
                self.cut[q] += select(seen, 1u32, 0u32);
            }
            self.open[q] = select(seen, left, self.open[q]);
            let blends = blended == 1u32;
            let weight = select(blends, alpha * self.t[q], 0.0f32);
            #[unroll]
            for channel in 0..width {
                self.sums[q * width + channel] += weight * color[channel];
            }
            self.t[q] = select(blends, next, self.t[q]);
            if comptime!(counting) {
                self.last[q] += blended;
            } else {
                self.last[q] = select(blends, next_entry, self.last[q]);
            }
        }
    }

    /// Writes the pixels that are in the image.
    fn store(
        &self,
        background: &ComptimeOption<&[f32]>,
        output: &mut [f32],
        transmittance: &mut [f32],
        walked: &mut [u32],
        grid: Grid,
        place: Place,
        channels: u32,
        first_channel: u32,
        #[comptime] plan: Plan,
        #[comptime] width: usize,
        #[comptime] first_launch: bool,
        #[comptime] counting: bool,
    ) {
        #[unroll]
        for q in 0..comptime!(plan.pixels()) {
            let (x, y) = place.pixel(q, plan);
            let (inside, pixel) = pixel_index(grid, place, x, y);
            if inside {
                let out = pixel * (channels as usize + 1) + first_channel as usize;
                #[unroll]
                for channel in 0..width {
                    let mut sum = self.sums[q * width + channel];
                    #[comptime]
                    if let ComptimeOption::Some(background) = background {
                        let at = (place.camera * channels + first_channel) as usize + channel;
                        sum += self.t[q] * background[at];
                    }
                    output[out + channel] = sum;
                }
                if comptime!(first_launch) {
                    output[out + channels as usize] = if comptime!(counting) {
                        self.cut[q] as f32
                    } else {
                        1.0f32 - self.t[q]
                    };
                    transmittance[pixel] = if comptime!(counting) {
                        self.tested[q] as f32
                    } else {
                        self.t[q]
                    };
                    walked[pixel] = self.last[q];
                }
            }
        }
    }
}

/// First entry and end of the list of the workgroup's tile, the same in all units.
#[cube]
fn list_of_tile(ranges: &[u32], grid: Grid, place: Place) -> (u32, u32) {
    let mut range = Shared::new_slice(2usize);
    if UNIT_POS == 0 {
        let mut start = 0u32;
        let mut end = 0u32;
        if place.tile < grid.tiles {
            start = ranges[place.tile as usize * 2];
            end = ranges[place.tile as usize * 2 + 1];
        }
        range[0] = start;
        range[1] = end;
    }
    let start = workgroup_uniform_load(&range[0]);
    let end = workgroup_uniform_load(&range[1]);
    (start, end)
}

/// The pixels walk the splats of a batch that meet their block, until all have stopped;
/// `next_entry` follows the place of its first splat in the list. Returns how many are open still.
#[cube]
fn walk_batch(
    pixels: &mut Pixels,
    batch: &Batch,
    open_before: u32,
    next_entry: u32,
    place: Place,
    thresholds: Thresholds,
    #[comptime] plan: Plan,
    #[comptime] width: usize,
    #[comptime] counting: bool,
) -> u32 {
    let mut open_pixels = open_before;
    for word in 0..WORDS {
        let mut bits = batch.bits(place.block, word);
        while bits != 0u32 && open_pixels > 0u32 {
            let k = word * 32 + bits.trailing_zeros() as usize;
            bits &= bits - 1u32;
            pixels.blend(
                &batch.splats,
                k * comptime!(SHAPE + width),
                next_entry + k as u32,
                place,
                thresholds,
                plan,
                width,
                counting,
            );
            open_pixels = pixels.count_open(plan);
        }
    }
    open_pixels
}

/// One workgroup per tile; `width` channels from `first_channel` on. Counting: instead of what is
/// left of the light and of the splats walked, every pixel writes how many splats were tested for
/// it and how many it blended, and as its alpha how many were past the alpha cut.
#[cube(launch)]
pub(super) fn rasterize_forward(
    packed: &[f32],
    colors: &[f32],
    opacities: &[f32],
    background: ComptimeOption<&[f32]>,
    splats: &[u32],
    ranges: &[u32],
    output: &mut [f32],
    transmittance: &mut [f32],
    walked: &mut [u32],
    grid: Grid,
    thresholds: Thresholds,
    channels: u32,
    first_channel: u32,
    #[comptime] plan: Plan,
    #[comptime] width: usize,
    #[comptime] first_launch: bool,
    #[comptime] counting: bool,
) {
    let units = comptime!(plan.units());
    let mut batch = Batch::new(plan, width);
    let finished = Shared::<[Atomic<u32>]>::new_slice(1usize);
    // Every block may walk the whole list: it is not known yet how far it gets.
    let ends = Shared::<[Atomic<u32>]>::new_slice(comptime!(plan.blocks()));
    let place = place(grid, plan);

    if UNIT_POS == 0 {
        Atomic::store(&finished[0], 0u32);
    }
    if place.lane == 0 {
        Atomic::store(&ends[place.block as usize], u32::MAX);
    }
    let (start, end) = list_of_tile(ranges, grid, place);

    let mut pixels = Pixels::new(grid, place, plan, width);
    let mut open_pixels = pixels.count_open(plan);
    if open_pixels == 0u32 {
        Atomic::fetch_add(&finished[0], 1u32);
    }
    sync_cube();

    let mut first = start;
    while first < end {
        // Also keeps the units together: the batch before is no longer read.
        if workgroup_uniform_load_atomic(&finished[0]) >= comptime!(units as u32) {
            break;
        }
        let count = min(comptime!(BATCH as u32), end - first);
        batch.clear(plan);
        sync_cube();
        let mut k = UNIT_POS;
        while k < count {
            let splat = splats[(first + k) as usize] as usize;
            let color = splat * channels as usize + first_channel as usize;
            batch.load(
                packed, colors, opacities, splat, color, k as usize, 0u32, &ends, grid, place,
                plan, width,
            );
            k += comptime!(units as u32);
        }
        sync_cube();

        let was_open = open_pixels > 0u32;
        open_pixels = walk_batch(
            &mut pixels,
            &batch,
            open_pixels,
            first + 1u32 - start,
            place,
            thresholds,
            plan,
            width,
            counting,
        );
        if was_open && open_pixels == 0u32 {
            Atomic::fetch_add(&finished[0], 1u32);
        }
        first += comptime!(BATCH as u32);
    }

    pixels.store(
        &background,
        output,
        transmittance,
        walked,
        grid,
        place,
        channels,
        first_channel,
        plan,
        width,
        first_launch,
        counting,
    );
}
