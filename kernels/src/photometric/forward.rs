//! The loss of each tile, and the means.

use cubecl::prelude::*;

use super::tile::{
    FIELDS, MOMENTS, PITCH, Place, RUNS, TILE_HEIGHT, TILE_WIDTH, UNITS, down_column, put,
    target_value,
};
use super::{Sizes, TargetKind};
use crate::launch::CUBE_UNITS_USIZE;
use crate::reduce::sum_units;
use crate::ssim::{RUN, UNROLLED_TAPS, load_window, terms, windowed};

/// Windows the rows of all moments of a tile into shared memory.
#[cube]
fn moments_of_rows(
    rendered: &[f32],
    target: &[u32],
    window: &Array<f32>,
    shared: &mut Shared<[f32]>,
    sizes: Sizes,
    place: Place,
    #[comptime] taps: usize,
    #[comptime] kind: TargetKind,
) {
    let unrolled = comptime!(taps <= UNROLLED_TAPS);
    let span = comptime!(RUN + taps - 1);
    let rows = comptime!(TILE_HEIGHT + taps - 1);
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
            windowed(&products, window, &mut sums, taps, unrolled);
            put(shared, &sums, field, row, run, taps);
        }
        task += UNITS;
    }
}

/// Sums of |x - y| and of S over the unit's run of a tile; if `keep`, the derivatives go to
/// `fields`.
#[cube]
fn measure_run(
    rendered: &[f32],
    target: &[u32],
    window: &Array<f32>,
    shared: &Shared<[f32]>,
    fields: &mut [f32],
    sizes: Sizes,
    place: Place,
    weight: f32,
    #[comptime] taps: usize,
    #[comptime] kind: TargetKind,
    #[comptime] keep: bool,
) -> (f32, f32) {
    let pixel = sizes.pixel as usize;
    let channels = sizes.channels as usize;
    let channel = place.channel as usize;
    let mut mx = Array::<f32>::new(RUN);
    let mut my = Array::<f32>::new(RUN);
    let mut q = Array::<f32>::new(RUN);
    let mut p = Array::<f32>::new(RUN);
    down_column(shared, 0usize, window, &mut mx, taps);
    down_column(shared, 1usize, window, &mut my, taps);
    down_column(shared, 2usize, window, &mut q, taps);
    down_column(shared, 3usize, window, &mut p, taps);
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
    (difference, similarity)
}

/// Sums of |x - y| and of S over a tile, to `partials[workgroup, 2]`; if `keep`, the derivatives
/// too.
#[cube(launch)]
pub(super) fn photometric_tiles(
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
    let rows = comptime!(TILE_HEIGHT + taps - 1);
    let mut shared = Shared::new_slice(comptime!(MOMENTS * rows * PITCH));
    let mut summed = Shared::new_slice(UNITS);
    let place = Place::new(sizes);
    let window = load_window(weights, taps, comptime!(taps <= UNROLLED_TAPS));
    moments_of_rows(
        rendered,
        target,
        &window,
        &mut shared,
        sizes,
        place,
        taps,
        kind,
    );
    sync_cube();
    let (difference, similarity) = measure_run(
        rendered, target, &window, &shared, fields, sizes, place, weight, taps, kind, keep,
    );
    let difference = sum_units(&mut summed, difference, UNITS);
    let similarity = sum_units(&mut summed, similarity, UNITS);
    if UNIT_POS == 0 && place.exists {
        partials[CUBE_POS * 2] = difference;
        partials[CUBE_POS * 2 + 1] = similarity;
    }
}

/// Sums over the tiles, in order, scaled to means. One workgroup.
#[cube(launch)]
pub(super) fn means_of_tiles(partials: &[f32], means: &mut [f32], tiles: u32, l1: f32, ssim: f32) {
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
