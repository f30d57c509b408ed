//! The gradient by splats: a bucket is 32 splats of a tile's list, and the units of a workgroup own one splat each. The
//! tile's pixels stream through them, back to front: a pixel comes to the last splat with the light that is left behind
//! the bucket and the gradient of what is there, and goes on to the one before it (Mallick et al. 2024, Taming 3DGS). No
//! sums over pixels between units; all buckets of a tile at once.
//!
//! The forward pass leaves of every bucket, per pixel, the light that is left behind it and the colour that it added: its
//! own, so that what is behind a bucket is a sum and no difference.
//!
//! Floor per bucket: 1,024 bytes and 1,024 per channel to memory in the forward pass; as many read, and 1,024 written, by
//! [`sum_behind`]; 3,072 and 1,024 per channel read. Per (tile, splat) pair 256 times 45 operations and 4 per channel.

use cubecl::prelude::*;

use super::backward::SlotLayout;
use super::pair::{SHAPE, Shape, Thresholds, UNSEEN, sample};
use crate::intersect::{Grid, TILE};
use crate::project::PACKED;

/// Splats of a bucket.
pub(super) const BUCKET: usize = 32;
/// Pixels of a tile.
pub(super) const TILE_PIXELS: usize = (TILE * TILE) as usize;

/// Most channels, of one launch.
pub(super) const MOST_STREAMED: usize = 8;

/// Buckets of all tiles; some between them are empty.
pub(super) fn buckets(instances: usize, tiles: usize) -> usize {
    instances / BUCKET + tiles
}

/// Number of a tile's first bucket, for a list that begins at `start`: each tile before it has room for one more than are
/// full.
#[cube]
pub(super) fn first_bucket(start: u32, tile: u32) -> u32 {
    start / comptime!(BUCKET as u32) + tile
}

/// Puts behind every bucket what the splats there do to the pixel: `behind` of `rasterize.rs`, in the place of the first
/// colour. One unit per pixel of a tile.
#[cube(launch)]
pub(super) fn sum_behind(
    background: &[f32],
    ranges: &[u32],
    transmittance: &[f32],
    walked: &[u32],
    grad_output: &[f32],
    checkpoints: &mut [f32],
    grid: Grid,
    channels: u32,
    #[comptime] width: usize,
    #[comptime] has_background: bool,
) {
    let tile = CUBE_POS as u32;
    let at = UNIT_POS;
    let in_image = tile % (grid.columns * grid.rows);
    let camera = tile / (grid.columns * grid.rows);
    let x = in_image % grid.columns * TILE + at % TILE;
    let y = in_image / grid.columns * TILE + at / TILE;
    if tile < grid.tiles && x < grid.width && y < grid.height {
        let pixel = ((camera * grid.height + y) * grid.width + x) as usize;
        let from = pixel * (width + 1);
        let mut g = Array::<f32>::new(width);
        let mut seen = 0.0f32;
        #[unroll]
        for channel in 0..width {
            g[channel] = grad_output[from + channel];
            if comptime!(has_background) {
                seen += g[channel] * background[(camera * channels) as usize + channel];
            }
        }
        seen -= grad_output[from + width];
        let mut behind = transmittance[pixel] * seen;
        let first = first_bucket(ranges[tile as usize * 2], tile);
        let mut bucket = walked[pixel].div_ceil(comptime!(BUCKET as u32));
        while bucket > 0u32 {
            bucket -= 1u32;
            let checkpoint = (first + bucket) as usize * comptime!(TILE_PIXELS * (width + 1));
            let checkpoint = checkpoint + TILE_PIXELS + at as usize;
            let mut dot = 0.0f32;
            #[unroll]
            for channel in 0..width {
                dot += g[channel] * checkpoints[checkpoint + channel * TILE_PIXELS];
            }
            checkpoints[checkpoint] = behind;
            behind += dot;
        }
    }
}

/// Gradients of the splats of a bucket, to their slots: one workgroup per bucket, whose units own as many splats each as
/// are needed. `planes`: the units are a plane, and hand their pixels on by themselves; otherwise through shared memory.
#[cube(launch)]
pub(super) fn rasterize_backward_per_splat(
    packed: &[f32],
    colors: &[f32],
    opacities: &[f32],
    splats: &[u32],
    slots: &[u32],
    ranges: &[u32],
    walked: &[u32],
    grad_output: &[f32],
    checkpoints: &[f32],
    slot_gradients: &mut [f32],
    grid: Grid,
    thresholds: Thresholds,
    #[comptime] layout: SlotLayout,
    #[comptime] units: usize,
    #[comptime] planes: bool,
) {
    let values = comptime!(layout.values());
    let each = comptime!(BUCKET / units);
    let width = comptime!(layout.width);
    let mut t = Shared::new_slice(TILE_PIXELS);
    let mut behind = Shared::new_slice(TILE_PIXELS);
    let mut last = Shared::new_slice(TILE_PIXELS);
    let mut g = Shared::new_slice(comptime!(TILE_PIXELS * width));
    let mut own = Shared::new_slice(3usize);
    let longest = Shared::<[Atomic<u32>]>::new_slice(1usize);

    // The last tile whose first bucket is not behind this one.
    if UNIT_POS == 0 {
        let bucket = CUBE_POS as u32;
        let mut low = 0u32;
        let mut high = grid.tiles;
        while high - low > 1u32 {
            let middle = (low + high) / 2u32;
            if first_bucket(ranges[middle as usize * 2], middle) <= bucket {
                low = middle;
            } else {
                high = middle;
            }
        }
        own[0] = low;
        own[1] = ranges[low as usize * 2];
        own[2] = ranges[low as usize * 2 + 1];
        Atomic::store(&longest[0], 0u32);
    }
    let tile = workgroup_uniform_load(&own[0]);
    let start = workgroup_uniform_load(&own[1]);
    let end = workgroup_uniform_load(&own[2]);
    let lane = UNIT_POS;
    let in_list = (CUBE_POS as u32 - first_bucket(start, tile)) * comptime!(BUCKET as u32);
    let in_image = tile % (grid.columns * grid.rows);
    let camera = tile / (grid.columns * grid.rows);
    let tile_x = in_image % grid.columns * TILE;
    let tile_y = in_image / grid.columns * TILE;

    // How far the tile's pixels have walked, from here.
    let mut far = 0u32;
    let mut p = lane as usize;
    while p < TILE_PIXELS {
        let (x, y) = (tile_x + p as u32 % TILE, tile_y + p as u32 / TILE);
        let mut until = 0u32;
        if x < grid.width && y < grid.height {
            let walked = walked[((camera * grid.height + y) * grid.width + x) as usize];
            until = select(walked > in_list, walked - in_list, 0u32);
        }
        last[p] = until;
        far = max(far, until);
        p += units;
    }
    Atomic::fetch_max(&longest[0], far);
    sync_cube();
    let far = workgroup_uniform_load_atomic(&longest[0]);
    if far > 0u32 {
        let mut p = lane as usize;
        while p < TILE_PIXELS {
            let mut light = 1.0f32;
            let mut gradient = 0.0f32;
            let seen = last[p] > 0u32;
            if seen {
                let (x, y) = (tile_x + p as u32 % TILE, tile_y + p as u32 / TILE);
                let pixel = ((camera * grid.height + y) * grid.width + x) as usize;
                let checkpoint = CUBE_POS * comptime!(TILE_PIXELS * (width + 1)) + p;
                light = checkpoints[checkpoint];
                gradient = checkpoints[checkpoint + TILE_PIXELS];
                #[unroll]
                for channel in 0..width {
                    g[p * width + channel] = grad_output[pixel * (width + 1) + channel];
                }
            } else {
                #[unroll]
                for channel in 0..width {
                    g[p * width + channel] = 0.0f32;
                }
            }
            t[p] = light;
            behind[p] = gradient;
            p += units;
        }
        let mut shapes = Array::<f32>::new(comptime!(each * SHAPE));
        let mut color = Array::<f32>::new(comptime!(each * width));
        let mut sums = Array::<f32>::new(comptime!(each * SHAPE));
        let mut color_sums = Array::<f32>::new(comptime!(each * width));
        #[unroll]
        for j in 0..each {
            let entry = start + in_list + lane * comptime!(each as u32) + j as u32;
            let at = select(entry < end, entry, start) as usize;
            let splat = splats[at] as usize;
            let from = splat * PACKED;
            shapes[j * SHAPE] = packed[from];
            shapes[j * SHAPE + 1] = packed[from + 1];
            shapes[j * SHAPE + 2] = packed[from + 3];
            shapes[j * SHAPE + 3] = packed[from + 4];
            shapes[j * SHAPE + 4] = packed[from + 5];
            // Behind the end of the list nothing is seen.
            shapes[j * SHAPE + 5] = select(entry < end, opacities[splat], 0.0f32);
            #[unroll]
            for i in 0..SHAPE {
                sums[j * SHAPE + i] = 0.0f32;
            }
            #[unroll]
            for channel in 0..width {
                color[j * width + channel] = colors[splat * width + channel];
                color_sums[j * width + channel] = 0.0f32;
            }
        }
        let mut handed_t = 1.0f32;
        let mut handed_behind = 0.0f32;
        sync_cube();

        // At every step a unit has the pixel that the unit of the splat behind had in the step before.
        for step in 0..comptime!((TILE_PIXELS + units - 1) as u32) {
            if comptime!(planes) {
                handed_t = plane_shuffle_down(handed_t, 1u32);
                handed_behind = plane_shuffle_down(handed_behind, 1u32);
            }
            let late = comptime!(units as u32 - 1) - lane;
            let streams = step >= late && step - late < comptime!(TILE_PIXELS as u32);
            let p = select(streams, step - late, 0u32);
            let p_index = p as usize;
            if comptime!(!planes) || late == 0u32 {
                handed_t = t[p_index];
                handed_behind = behind[p_index];
            }
            let until = select(streams, last[p_index], 0u32);
            let x = (tile_x + p % TILE) as f32 + 0.5f32;
            let y = (tile_y + p / TILE) as f32 + 0.5f32;
            #[unroll]
            for i in 0..each {
                let j = comptime!(each - 1) - i;
                let shape = Shape {
                    mean_x: shapes[j * SHAPE],
                    mean_y: shapes[j * SHAPE + 1],
                    w11: shapes[j * SHAPE + 2],
                    w21: shapes[j * SHAPE + 3],
                    w22: shapes[j * SHAPE + 4],
                    opacity: shapes[j * SHAPE + 5],
                };
                let s = sample(shape, x, y);
                let entry = lane * comptime!(each as u32) + j as u32;
                let raw = select(entry < until, s.raw, UNSEEN);
                let seen = thresholds.seen(raw);
                let alpha = select(seen, thresholds.alpha(raw), 0.0f32);
                let clear = 1.0f32 - alpha;
                let before = handed_t / clear;
                let weight = alpha * before;
                let mut dot = 0.0f32;
                #[unroll]
                for channel in 0..width {
                    let value = g[p_index * width + channel];
                    dot += color[j * width + channel] * value;
                    color_sums[j * width + channel] += weight * value;
                }
                let g_alpha = before * dot - handed_behind / clear;
                let g_sigma = select(thresholds.capped(raw), 0.0f32, -g_alpha * raw);
                let g_sigma = select(seen, g_sigma, 0.0f32);
                let g_z1 = g_sigma * select(seen, s.z1, 0.0f32);
                let g_z2 = g_sigma * select(seen, s.z2, 0.0f32);
                sums[j * SHAPE] += g_sigma;
                sums[j * SHAPE + 1] += g_z1;
                sums[j * SHAPE + 2] += g_z2;
                sums[j * SHAPE + 3] += g_z1 * s.dx;
                sums[j * SHAPE + 4] += g_z2 * s.dx;
                sums[j * SHAPE + 5] += g_z2 * s.dy;
                handed_t = before;
                handed_behind += weight * dot;
            }
            if comptime!(!planes) {
                if streams {
                    t[p_index] = handed_t;
                    behind[p_index] = handed_behind;
                }
                sync_cube();
            }
        }

        #[unroll]
        for j in 0..each {
            let entry = start + in_list + lane * comptime!(each as u32) + j as u32;
            if entry < end {
                let to = slots[entry as usize] as usize * values;
                if comptime!(layout.shape) {
                    let (w11, w21) = (shapes[j * SHAPE + 2], shapes[j * SHAPE + 3]);
                    let (w22, opacity) = (shapes[j * SHAPE + 4], shapes[j * SHAPE + 5]);
                    let (sum_z1, sum_z2) = (sums[j * SHAPE + 1], sums[j * SHAPE + 2]);
                    slot_gradients[to] = -(w11 * sum_z1 + w21 * sum_z2);
                    slot_gradients[to + 1] = -(w22 * sum_z2);
                    slot_gradients[to + 2] = sums[j * SHAPE + 3];
                    slot_gradients[to + 3] = sums[j * SHAPE + 4];
                    slot_gradients[to + 4] = sums[j * SHAPE + 5];
                    slot_gradients[to + 5] = -sums[j * SHAPE] / opacity;
                }
                if comptime!(layout.colors) {
                    #[unroll]
                    for channel in 0..width {
                        slot_gradients[to + comptime!(layout.first_color()) + channel] =
                            color_sums[j * width + channel];
                    }
                }
            }
        }
    }
}
