//! The gradient of every (tile, splat) pair, back to front; `sums.rs` has what becomes of it.
//!
//! With g = dL/dsigma of one pixel, all gradients of a splat's shape follow from six sums over pixels:
//! ```text
//! A = Σ g,  B = Σ g z1,  C = Σ g z2,  D = Σ g z1 dx,  E = Σ g z2 dx,  F = Σ g z2 dy
//! dL/dw11 = D,  dL/dw21 = E,  dL/dw22 = F,  dL/dmean = -(w11 B + w21 C, w22 C),  dL/do = -A / o
//! ```
//! Each block sums its pixels, and the tile its blocks (in order). One value of a pair goes to its slot, or is added to
//! the splat's gradient at once.
//!
//! Floor per (block, splat) pair: as forward, plus 24 bytes and 4 per channel to shared memory; per pixel of the block
//! about 45 operations and 4 per channel. Per (tile, splat) pair: 32 bytes and 4 per channel from memory (28 without
//! slots), and what `sums.rs` counts.

use cubecl::prelude::*;

use super::pair::{SHAPE, Shape, Thresholds, UNSEEN, sample};
use super::sums::{Sums, Target, TargetExpand, add_to_splat};
use super::tile::{BATCH, Batch, Plan, WORDS, pixel_index, place};
use crate::intersect::Grid;

/// Gradients of a splat's shape and opacity in a slot, in the order of [`SHAPE`]; those of colours follow.
pub(super) const SHAPE_GRADIENTS: usize = SHAPE;

/// Floats in the shared memory that every device has.
const SHARED: usize = 16_384 / 4;
/// Most floats of partial sums in it, where the batch leaves as many.
const MAX_PARTIALS: usize = 2304;

/// Which values a launch of the backward pass sums, and how many there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct SlotLayout {
    /// Gradients of shape and opacity, [`SHAPE_GRADIENTS`] of them, come first.
    pub shape: bool,
    /// Then those of the colours.
    pub colors: bool,
    /// Channels of this launch.
    pub width: usize,
}

impl SlotLayout {
    pub fn values(self) -> usize {
        self.first_color() + if self.colors { self.width } else { 0 }
    }

    pub fn first_color(self) -> usize {
        if self.shape { SHAPE_GRADIENTS } else { 0 }
    }

    /// Floats in shared memory beside the partial sums: the batch, its targets and bits, and how far the blocks have walked.
    fn batch(self, plan: Plan) -> usize {
        BATCH * (SHAPE + self.width) + 2 * BATCH + plan.blocks() * (WORDS + 1) + 2
    }

    /// Splats whose partial sums are in shared memory at once: a power of two, so that they share a word of bits.
    fn group(self, plan: Plan) -> usize {
        let room = SHARED.saturating_sub(self.batch(plan)).min(MAX_PARTIALS);
        let most = room / (self.values() * plan.blocks());
        let power = usize::BITS - 1 - most.max(1).leading_zeros();
        1 << power.min(5)
    }
}

/// Gradients of every (tile, splat) pair: one workgroup per tile, back to front. They go to `target`, to splats as `sums`
/// says.
#[cube(launch)]
pub(super) fn rasterize_backward<A: Numeric>(
    packed: &[f32],
    colors: &[f32],
    opacities: &[f32],
    background: ComptimeOption<&[f32]>,
    splats: &[u32],
    ranges: &[u32],
    transmittance: &[f32],
    walked: &[u32],
    grad_output: &[f32],
    mut target: Target<A>,
    grid: Grid,
    thresholds: Thresholds,
    channels: u32,
    first_channel: u32,
    #[comptime] plan: Plan,
    #[comptime] layout: SlotLayout,
    #[comptime] sums: Sums,
    #[comptime] first_launch: bool,
) {
    let values = comptime!(layout.values());
    let group = comptime!(layout.group(plan));
    let width = comptime!(layout.width);
    let pixels = comptime!(plan.pixels());
    let units = comptime!(plan.units());
    let blocks = comptime!(plan.blocks());

    let mut batch = Batch::new(plan, width);
    // Of every splat of the batch: its slot, or without slots its index.
    let mut targets = Shared::new_slice(BATCH);
    // Place k of the group, value, block.
    let mut partials = Shared::new_slice(comptime!(group * values * blocks));
    let mut start = Shared::new_slice(1usize);
    // How far the pixels of every block have walked, and those of the tile.
    let ends = Shared::<[Atomic<u32>]>::new_slice(blocks);
    let longest = Shared::<[Atomic<u32>]>::new_slice(1usize);
    let place = place(grid, plan);

    if UNIT_POS == 0 {
        let mut first = 0u32;
        if place.tile < grid.tiles {
            first = ranges[place.tile as usize * 2];
        }
        start[0] = first;
        Atomic::store(&longest[0], 0u32);
    }
    if place.lane == 0 {
        Atomic::store(&ends[place.block as usize], 0u32);
    }
    sync_cube();

    let mut t = Array::<f32>::new(pixels);
    let mut behind = Array::<f32>::new(pixels);
    let mut last = Array::<u32>::new(pixels);
    let mut g = Array::<f32>::new(comptime!(pixels * width));
    #[unroll]
    for q in 0..pixels {
        let (x, y) = place.pixel(q, plan);
        let (inside, pixel) = pixel_index(grid, place, x, y);
        t[q] = 1.0f32;
        behind[q] = 0.0f32;
        last[q] = 0u32;
        #[unroll]
        for channel in 0..width {
            g[q * width + channel] = 0.0f32;
        }
        if inside {
            let from = pixel * (channels as usize + 1) + first_channel as usize;
            let end = transmittance[pixel];
            t[q] = end;
            last[q] = walked[pixel];
            let mut seen = 0.0f32;
            #[unroll]
            for channel in 0..width {
                let value = grad_output[from + channel];
                g[q * width + channel] = value;
                #[comptime]
                if let ComptimeOption::Some(background) = &background {
                    let at = (place.camera * channels + first_channel) as usize + channel;
                    seen += value * background[at];
                }
            }
            if comptime!(first_launch) {
                seen -= grad_output[from + channels as usize];
            }
            behind[q] = end * seen;
            Atomic::fetch_max(&ends[place.block as usize], last[q]);
            Atomic::fetch_max(&longest[0], last[q]);
        }
    }
    sync_cube();
    let start = workgroup_uniform_load(&start[0]);
    let mut remaining = workgroup_uniform_load_atomic(&longest[0]);

    // Batches from the back; place k of a batch holds entry remaining - 1 - k.
    while remaining > 0u32 {
        let count = min(comptime!(BATCH as u32), remaining);
        batch.clear(plan);
        sync_cube();
        let mut k = UNIT_POS;
        while k < count {
            let entry = remaining - 1u32 - k;
            let at = (start + entry) as usize;
            let splat = splats[at] as usize;
            let color = splat * channels as usize + first_channel as usize;
            #[comptime]
            let to = match &target {
                Target::Slots(slots) => slots.of[at],
                Target::Splats(_) => splats[at],
            };
            targets[k as usize] = to;
            batch.load(
                packed, colors, opacities, splat, color, k as usize, entry, &ends, grid, place,
                plan, width,
            );
            k += comptime!(units as u32);
        }
        sync_cube();

        let mut from = 0u32;
        while from < count {
            let mask = comptime!(u32::MAX >> (32 - group as u32));
            let mut bits = batch.bits(place.block, from as usize / 32) >> (from % 32u32) & mask;
            while bits != 0u32 {
                let in_group = bits.trailing_zeros();
                bits &= bits - 1u32;
                let k = (from + in_group) as usize;
                let entry = remaining - 1u32 - k as u32;
                let at = k * comptime!(SHAPE + width);
                let shape = Shape::load(&batch.splats, at);
                let mut color = Array::<f32>::new(width);
                #[unroll]
                for channel in 0..width {
                    color[channel] = batch.splats[at + SHAPE + channel];
                }
                let mut color_sums = Array::<f32>::new(width);
                #[unroll]
                for channel in 0..width {
                    color_sums[channel] = 0.0f32;
                }
                let mut sum = 0.0f32;
                let mut sum_z1 = 0.0f32;
                let mut sum_z2 = 0.0f32;
                let mut sum_z1_dx = 0.0f32;
                let mut sum_z2_dx = 0.0f32;
                let mut sum_z2_dy = 0.0f32;
                #[unroll]
                for q in 0..pixels {
                    let (x, y) = place.pixel(q, plan);
                    let s = sample(shape, x as f32 + 0.5f32, y as f32 + 0.5f32);
                    let raw = select(entry < last[q], s.raw, UNSEEN);
                    let seen = thresholds.seen(raw);
                    let alpha = select(seen, thresholds.alpha(raw), 0.0f32);
                    let clear = 1.0f32 - alpha;
                    let before = t[q] / clear;
                    let weight = alpha * before;
                    let mut dot = 0.0f32;
                    #[unroll]
                    for channel in 0..width {
                        let value = g[q * width + channel];
                        dot += color[channel] * value;
                        if comptime!(layout.colors) {
                            color_sums[channel] += weight * value;
                        }
                    }
                    if comptime!(layout.shape) {
                        let g_alpha = before * dot - behind[q] / clear;
                        let g_sigma = select(thresholds.capped(raw), 0.0f32, -g_alpha * raw);
                        let g_sigma = select(seen, g_sigma, 0.0f32);
                        // Far from the splat a broken one may overflow.
                        let g_z1 = g_sigma * select(seen, s.z1, 0.0f32);
                        let g_z2 = g_sigma * select(seen, s.z2, 0.0f32);
                        sum += g_sigma;
                        sum_z1 += g_z1;
                        sum_z2 += g_z2;
                        sum_z1_dx += g_z1 * s.dx;
                        sum_z2_dx += g_z2 * s.dx;
                        sum_z2_dy += g_z2 * s.dy;
                    }
                    behind[q] += weight * dot;
                    t[q] = before;
                }

                let mut parts = Array::<f32>::new(values);
                if comptime!(layout.shape) {
                    // d = pixel - mean
                    parts[0] = -(shape.w11 * sum_z1 + shape.w21 * sum_z2);
                    parts[1] = -(shape.w22 * sum_z2);
                    parts[2] = sum_z1_dx;
                    parts[3] = sum_z2_dx;
                    parts[4] = sum_z2_dy;
                    parts[5] = -sum / shape.opacity;
                }
                if comptime!(layout.colors) {
                    #[unroll]
                    for channel in 0..width {
                        parts[comptime!(layout.first_color()) + channel] = color_sums[channel];
                    }
                }
                // All units of a plane are here together: they walk the same block.
                if comptime!(plan.lanes() > 1) {
                    #[unroll]
                    for value in 0..values {
                        parts[value] = plane_sum(parts[value]);
                    }
                }
                if place.lane == 0 {
                    let to = in_group as usize * comptime!(values * blocks);
                    #[unroll]
                    for value in 0..values {
                        partials[to + value * blocks + place.block as usize] = parts[value];
                    }
                }
            }
            sync_cube();
            // One unit sums one value of one splat over the blocks that have walked it.
            let mut row = UNIT_POS as usize;
            while row < comptime!(group * values) {
                let k = from as usize + row / values;
                if k < count as usize {
                    let to = targets[k] as usize;
                    let mut touched = batch.touched[k];
                    let walked = touched != 0u32;
                    let mut sum = 0.0f32;
                    while touched != 0u32 {
                        sum += partials[row * blocks + touched.trailing_zeros() as usize];
                        touched &= touched - 1u32;
                    }
                    #[comptime]
                    match &mut target {
                        Target::Slots(slots) => {
                            slots.gradients[to * values + row % values] = sum;
                        }
                        Target::Splats(gradients) => {
                            if walked {
                                add_to_splat(
                                    gradients,
                                    to,
                                    row % values,
                                    sum,
                                    channels as usize,
                                    first_channel as usize,
                                    layout,
                                    sums,
                                );
                            }
                        }
                    }
                }
                row += units;
            }
            sync_cube();
            from += comptime!(group as u32);
        }
        remaining -= count;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_layout_fits_into_the_shared_memory_of_any_device() {
        for lanes in [1, 8, 16, 32, 64] {
            let plan = Plan::with_lanes(lanes);
            for width in 1..=plan.channels() {
                for (shape, colors) in [(true, true), (true, false), (false, true)] {
                    let layout = SlotLayout {
                        shape,
                        colors,
                        width,
                    };
                    let group = layout.group(plan);
                    assert!(32 % group == 0, "a group shares a word of bits");
                    let partials = group * layout.values() * plan.blocks();
                    let bytes = 4 * (layout.batch(plan) + partials);
                    assert!(bytes <= 16_384, "{bytes} bytes: {lanes} lanes, {layout:?}");
                }
            }
        }
    }
}
