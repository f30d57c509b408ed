//! Sums over many units in a fixed order: by halves within a workgroup, then workgroup by
//! workgroup.
//!
//! Floor per value: 4 bytes read and one addition.

use cubecl::prelude::*;

use crate::launch::{Buffer, per_element};

/// Sum of `value` over the `units` of the workgroup, a power of two. All units must call it.
/// `shared` holds one float per unit.
#[cube]
pub(crate) fn sum_units(shared: &mut Shared<[f32]>, value: f32, #[comptime] units: usize) -> f32 {
    let unit = UNIT_POS as usize;
    shared[unit] = value;
    sync_cube();
    let mut half = comptime!(units / 2).runtime();
    while half > 0 {
        if unit < half {
            let other = shared[unit + half];
            shared[unit] += other;
        }
        sync_cube();
        half /= 2;
    }
    let sum = shared[0];
    // The next sum must not overwrite values that another unit has yet to read.
    sync_cube();
    sum
}

/// `out[row, k]` = Σ over blocks of `partials[row, block, k]`, in order.
#[cube(launch)]
fn sum_blocks_in_order(partials: &[f32], out: &mut [f32], rows: u32, blocks: u32, values: u32) {
    let row = ABSOLUTE_POS as u32 / values;
    let k = ABSOLUTE_POS as u32 % values;
    if row < rows {
        let mut sum = 0.0f32;
        for block in 0..blocks {
            sum += partials[((row * blocks + block) * values + k) as usize];
        }
        out[ABSOLUTE_POS] = sum;
    }
}

/// Reduces partial sums [`rows`, `blocks`, `values`] to sums [`rows`, `values`].
pub(crate) fn sum_blocks(
    client: &Client,
    partials: &Buffer,
    [rows, blocks, values]: [usize; 3],
) -> Buffer {
    let out = Buffer::empty(client, rows * values);
    if let Some((count, dim)) = per_element(out.len()) {
        sum_blocks_in_order::launch(
            client,
            count,
            dim,
            partials.arg(),
            out.arg(),
            rows as u32,
            blocks as u32,
            values as u32,
        );
    }
    out
}
