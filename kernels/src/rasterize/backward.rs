//! The gradient of every intersection, back to front; `sums.rs` has what becomes of it.
//!
//! With g = dL/dsigma of one pixel, all gradients of a splat's shape follow from six sums over
//! pixels:
//! ```text
//! A = Σ g,  B = Σ g z1,  C = Σ g z2,  D = Σ g z1 dx,  E = Σ g z2 dx,  F = Σ g z2 dy
//! dL/dw11 = D,  dL/dw21 = E,  dL/dw22 = F,  dL/dmean = -(w11 B + w21 C, w22 C),  dL/do = -A / o
//! ```
//! Each block sums its pixels, and the tile its blocks (in order). One value of an intersection
//! goes to its slot, or is added to the splat's gradient at once.
//!
//! Where absolute gradients of the mean are asked for, two sums more: `Σ |g (w11 z1 + w21 z2)|` and
//! `Σ |g w22 z2|`.
//!
//! Floor per (block, splat) pair: as forward, plus 24 bytes and 4 per channel to shared memory; per
//! pixel of the block about 45 operations and 4 per channel. Per intersection: 32 bytes and 4 per
//! channel from memory (28 without slots), and what `sums.rs` counts.

mod pixels;

use cubecl::prelude::*;

use self::pixels::Pixels;
use super::pair::{SHAPE, Thresholds};
use super::slots::SlotLayout;
use super::sums::{Sums, Target, TargetExpand, add_to_splat};
use super::tile::{BATCH, Batch, Place, Plan, place};
use crate::intersect::Grid;

/// First entry of the list of the workgroup's tile, the same in all units, which have waited for
/// each other.
#[cube]
fn first_of_tile(ranges: &[u32], grid: Grid, place: Place) -> u32 {
    let mut start = Shared::new_slice(1usize);
    if UNIT_POS == 0 {
        let mut first = 0u32;
        if place.tile < grid.tiles {
            first = ranges[place.tile as usize * 2];
        }
        start[0] = first;
    }
    sync_cube();
    workgroup_uniform_load(&start[0])
}

/// Reads the splats of a batch and their targets; place k of it holds entry `remaining - 1 - k`.
#[cube]
fn load_batch<A: Numeric>(
    batch: &mut Batch,
    targets: &mut Shared<[u32]>,
    target: &Target<A>,
    packed: &[f32],
    colors: &[f32],
    opacities: &[f32],
    splats: &[u32],
    start: u32,
    remaining: u32,
    count: u32,
    ends: &[Atomic<u32>],
    channels: usize,
    first_channel: usize,
    grid: Grid,
    place: Place,
    #[comptime] plan: Plan,
    #[comptime] width: usize,
) {
    let mut k = UNIT_POS;
    while k < count {
        let entry = remaining - 1u32 - k;
        let at = (start + entry) as usize;
        let splat = splats[at] as usize;
        let color = splat * channels + first_channel;
        #[comptime]
        let to = match target {
            Target::Slots(slots) => slots.of[at],
            Target::Splats(_) => splats[at],
        };
        targets[k as usize] = to;
        batch.load(
            packed, colors, opacities, splat, color, k as usize, entry, ends, grid, place, plan,
            width,
        );
        k += comptime!(plan.units() as u32);
    }
}

/// The pixels walk the splats of a group that meet their block; the block's sums of each go to
/// `partials`.
#[cube]
fn walk_group(
    pixels: &mut Pixels,
    batch: &Batch,
    partials: &mut Shared<[f32]>,
    colors: &[f32],
    grad_output: &[f32],
    splats: &[u32],
    start: u32,
    from: u32,
    remaining: u32,
    channels: usize,
    grid: Grid,
    place: Place,
    thresholds: Thresholds,
    #[comptime] plan: Plan,
    #[comptime] layout: SlotLayout,
) {
    let values = comptime!(layout.values());
    let group = comptime!(layout.group(plan));
    let width = comptime!(layout.width);
    let blocks = comptime!(plan.blocks());
    let mask = comptime!(u32::MAX >> (32 - group as u32));
    let mut bits = batch.bits(place.block, from as usize / 32) >> (from % 32u32) & mask;
    while bits != 0u32 {
        let in_group = bits.trailing_zeros();
        bits &= bits - 1u32;
        let k = (from + in_group) as usize;
        let entry = remaining - 1u32 - k as u32;
        let at = k * comptime!(SHAPE + width);
        let mut splat = 0usize;
        if comptime!(layout.reads_all_channels()) {
            splat = splats[(start + entry) as usize] as usize;
        }
        let mut parts = pixels.gradients(
            &batch.splats,
            at,
            entry,
            colors,
            grad_output,
            splat,
            channels,
            grid,
            place,
            thresholds,
            plan,
            layout,
        );
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
}

/// One unit sums one value of one splat of a group over the blocks that have walked it; the sum
/// goes to `target`.
#[cube]
fn sum_group<A: Numeric>(
    target: &mut Target<A>,
    targets: &Shared<[u32]>,
    batch: &Batch,
    partials: &Shared<[f32]>,
    from: u32,
    count: u32,
    channels: usize,
    first_channel: usize,
    #[comptime] plan: Plan,
    #[comptime] layout: SlotLayout,
    #[comptime] sums: Sums,
) {
    let values = comptime!(layout.values());
    let group = comptime!(layout.group(plan));
    let blocks = comptime!(plan.blocks());
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
            match target {
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
                            channels,
                            first_channel,
                            layout,
                            sums,
                        );
                    }
                }
            }
        }
        row += comptime!(plan.units());
    }
}

/// Gradients of every intersection: one workgroup per tile, back to front. They go to `target`, to
/// splats as `sums` says.
// Longer than a hundred lines by its arguments and those of the steps that it calls.
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
    let blocks = comptime!(plan.blocks());

    let mut batch = Batch::new(plan, width);
    // Slot of every splat of the batch; without slots its index.
    let mut targets = Shared::new_slice(BATCH);
    // Place k of the group, value, block.
    let mut partials = Shared::new_slice(comptime!(group * values * blocks));
    // How far the pixels of every block have walked, and those of the tile.
    let ends = Shared::<[Atomic<u32>]>::new_slice(blocks);
    let longest = Shared::<[Atomic<u32>]>::new_slice(1usize);
    let place = place(grid, plan);

    if UNIT_POS == 0 {
        Atomic::store(&longest[0], 0u32);
    }
    if place.lane == 0 {
        Atomic::store(&ends[place.block as usize], 0u32);
    }
    sync_cube();

    let mut pixels = Pixels::load(
        &background,
        transmittance,
        walked,
        grad_output,
        &ends,
        &longest,
        grid,
        place,
        channels,
        first_channel,
        plan,
        layout,
        first_launch,
    );
    let start = first_of_tile(ranges, grid, place);
    let mut remaining = workgroup_uniform_load_atomic(&longest[0]);

    // Batches from the back; place k of a batch holds entry remaining - 1 - k.
    while remaining > 0u32 {
        let count = min(comptime!(BATCH as u32), remaining);
        batch.clear(plan);
        sync_cube();
        load_batch(
            &mut batch,
            &mut targets,
            &target,
            packed,
            colors,
            opacities,
            splats,
            start,
            remaining,
            count,
            &ends,
            channels as usize,
            first_channel as usize,
            grid,
            place,
            plan,
            width,
        );
        sync_cube();

        let mut from = 0u32;
        while from < count {
            walk_group(
                &mut pixels,
                &batch,
                &mut partials,
                colors,
                grad_output,
                splats,
                start,
                from,
                remaining,
                channels as usize,
                grid,
                place,
                thresholds,
                plan,
                layout,
            );
            sync_cube();
            sum_group(
                &mut target,
                &targets,
                &batch,
                &partials,
                from,
                count,
                channels as usize,
                first_channel as usize,
                plan,
                layout,
                sums,
            );
            sync_cube();
            from += comptime!(group as u32);
        }
        remaining -= count;
    }
}
