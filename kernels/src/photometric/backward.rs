//! The gradient of the loss.

use cubecl::prelude::*;

use super::tile::{
    FIELDS, PITCH, Place, RUNS, TILE_HEIGHT, TILE_WIDTH, UNITS, down_column, put, target_value,
};
use super::{Sizes, TargetKind};
use crate::ssim::{RUN, UNROLLED_TAPS, load_window, windowed};

/// Windows the derivatives and combines them with the sign of x - y: the gradient of x; zero for
/// channels beyond the photo's.
#[cube(launch)]
pub(super) fn photometric_gradient(
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

    // Fields are stored channel by channel: each plane is an image of one channel.
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
