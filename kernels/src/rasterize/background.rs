//! The gradient of the background: per camera and channel the sum over pixels of T_end g, by blocks
//! of pixels and then over the blocks, in order.
//!
//! Floor per pixel: 4 bytes and 4 per channel from memory, 2 operations per channel.

use cubecl::prelude::*;

use super::RasterizeState;
use crate::intersect::Frames;
use crate::launch::{Buffer, CUBE_UNITS, CUBE_UNITS_USIZE, cube_count};
use crate::reduce::{sum_blocks, sum_units};

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
        let sum = sum_units(&mut shared, sum, CUBE_UNITS_USIZE);
        if unit == 0 && camera < cameras as usize {
            partials[CUBE_POS * channels as usize + channel] = sum;
        }
    }
}

pub(super) fn background_gradient(
    client: &Client,
    state: &RasterizeState,
    grad_output: &Buffer,
    channels: usize,
    frames: &Frames,
) -> Buffer {
    let pixels = frames.width as usize * frames.height as usize;
    let blocks = pixels.div_ceil(BACKGROUND_BLOCK);
    let partials = Buffer::empty(client, frames.cameras * blocks * channels);
    if !partials.is_empty() {
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
    }
    sum_blocks(client, &partials, [frames.cameras, blocks, channels])
}
