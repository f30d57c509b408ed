//! Stable least-significant-digit radix sort of (`u32` key, `u32` value) pairs, any length.
//!
//! Four bits a pass, three steps each: count the digits of every block, scan the counts digit by digit over all
//! blocks, move every pair to its place. Ranks inside a block come from counters of every unit in shared memory,
//! scanned in the order (digit, unit): no plane operations, so any plane size sorts alike.

use cubecl::prelude::*;

use crate::launch::{Buffer, CUBE_UNITS, CUBE_UNITS_USIZE, cube_count, per_element};
use crate::scan::{cube_exclusive_sum, exclusive_sum};

const DIGIT_BITS: u32 = 4;
const DIGITS: usize = 1 << DIGIT_BITS;
/// Consecutive pairs of one unit.
const ITEMS: usize = 8;
const BLOCK: usize = CUBE_UNITS_USIZE * ITEMS;

/// Which of the [`DIGITS`] bins the pass at `shift` puts `key` in; `mask` leaves out bits that are not to be sorted by.
#[cube]
fn digit_of(key: u32, shift: u32, mask: u32) -> usize {
    ((key >> shift) & mask) as usize
}

/// `counts[digit * blocks + block]` = keys of `block` with that digit.
#[cube(launch)]
fn count_digits(keys: &[u32], counts: &mut [u32], len: u32, blocks: u32, shift: u32, mask: u32) {
    let histogram = Shared::<[Atomic<u32>]>::new_slice(DIGITS);
    let unit = UNIT_POS as usize;
    if unit < DIGITS {
        Atomic::store(&histogram[unit], 0u32);
    }
    sync_cube();
    for item in 0..ITEMS {
        let at = CUBE_POS * BLOCK + item * CUBE_UNITS_USIZE + unit;
        if at < len as usize {
            Atomic::fetch_add(&histogram[digit_of(keys[at], shift, mask)], 1u32);
        }
    }
    sync_cube();
    if unit < DIGITS && CUBE_POS < blocks as usize {
        counts[unit * blocks as usize + CUBE_POS] = Atomic::load(&histogram[unit]);
    }
}

/// Moves every pair to `starts[digit, block]` + its rank among the block's pairs with that digit.
#[cube(launch)]
fn scatter(
    keys: &[u32],
    values: &[u32],
    starts: &[u32],
    keys_out: &mut [u32],
    values_out: &mut [u32],
    len: u32,
    blocks: u32,
    shift: u32,
    mask: u32,
) {
    // ranks[digit * CUBE_UNITS + unit]: first the unit's count of the digit, then the rank of its next such pair.
    let mut ranks = Shared::new_slice(DIGITS * CUBE_UNITS_USIZE);
    let mut shared = Shared::new_slice(CUBE_UNITS_USIZE);
    let mut digit_ranks = Shared::new_slice(DIGITS);
    let unit = UNIT_POS as usize;
    let first = CUBE_POS * BLOCK + unit * ITEMS;

    for digit in 0..DIGITS {
        ranks[digit * CUBE_UNITS_USIZE + unit] = 0u32;
    }
    for item in 0..ITEMS {
        if first + item < len as usize {
            ranks[digit_of(keys[first + item], shift, mask) * CUBE_UNITS_USIZE + unit] += 1u32;
        }
    }
    sync_cube();

    // Scan of all DIGITS x CUBE_UNITS counters: every unit takes DIGITS consecutive ones.
    let mut sum = 0u32;
    for k in 0..DIGITS {
        sum += ranks[unit * DIGITS + k];
    }
    let (before, _total) = cube_exclusive_sum(sum, &mut shared);
    let mut running = before;
    for k in 0..DIGITS {
        let count = ranks[unit * DIGITS + k];
        ranks[unit * DIGITS + k] = running;
        running += count;
    }
    sync_cube();
    if unit < DIGITS {
        digit_ranks[unit] = ranks[unit * CUBE_UNITS_USIZE];
    }
    sync_cube();

    for item in 0..ITEMS {
        if first + item < len as usize {
            let key = keys[first + item];
            let digit = digit_of(key, shift, mask);
            let rank = ranks[digit * CUBE_UNITS_USIZE + unit];
            ranks[digit * CUBE_UNITS_USIZE + unit] = rank + 1u32;
            let to = starts[digit * blocks as usize + CUBE_POS] + rank - digit_ranks[digit];
            keys_out[to as usize] = key;
            values_out[to as usize] = values[first + item];
        }
    }
}

/// `values[i] = i`.
#[cube(launch)]
fn count_up(values: &mut [u32], len: u32) {
    if ABSOLUTE_POS < len as usize {
        values[ABSOLUTE_POS] = ABSOLUTE_POS as u32;
    }
}

/// 0, 1, ..., `len` - 1.
pub fn iota(client: &Client, len: usize) -> Buffer {
    let values = Buffer::empty(client, len);
    if let Some((count, dim)) = per_element(len) {
        count_up::launch(client, count, dim, values.arg(), len as u32);
    }
    values
}

/// Sorts the pairs by the lowest `key_bits` bits of their keys, ascending; pairs of equal keys keep their order.
/// Pairs without a partner (one buffer longer than the other) are dropped.
pub fn sort_pairs(
    client: &Client,
    keys: &Buffer,
    values: &Buffer,
    key_bits: u32,
) -> (Buffer, Buffer) {
    let len = keys.len().min(values.len());
    let (mut keys, mut values) = (keys.clone(), values.clone());
    if len == 0 {
        return (Buffer::empty(client, 0), Buffer::empty(client, 0));
    }
    let blocks = len.div_ceil(BLOCK);
    let dim = CubeDim::new_1d(CUBE_UNITS);
    let mut shift = 0;
    let key_bits = key_bits.min(32);
    while shift < key_bits {
        let mask = (1 << DIGIT_BITS.min(key_bits - shift)) - 1;
        let counts = Buffer::empty(client, DIGITS * blocks);
        count_digits::launch(
            client,
            cube_count(blocks),
            dim,
            keys.arg(),
            counts.arg(),
            len as u32,
            blocks as u32,
            shift,
            mask,
        );
        let starts = exclusive_sum(client, &counts);
        let keys_out = Buffer::empty(client, len);
        let values_out = Buffer::empty(client, len);
        scatter::launch(
            client,
            cube_count(blocks),
            dim,
            keys.arg(),
            values.arg(),
            starts.arg(),
            keys_out.arg(),
            values_out.arg(),
            len as u32,
            blocks as u32,
            shift,
            mask,
        );
        (keys, values) = (keys_out, values_out);
        shift += DIGIT_BITS;
    }
    (keys, values)
}

/// How many bits the numbers below `count` need.
pub fn bits_for(count: usize) -> u32 {
    usize::BITS - count.saturating_sub(1).leading_zeros()
}

/// The bits of a float, changed so that unsigned order is numerical order: negative ones are flipped whole, the others
/// in the sign only. -0 counts as 0.
#[cube]
pub(crate) fn ordered_bits(value: f32) -> u32 {
    let mut bits = u32::reinterpret(value);
    if bits == 0x8000_0000u32 {
        bits = 0u32;
    }
    let flip = select(bits >> 31u32 == 1u32, 0xffff_ffffu32, 0x8000_0000u32);
    bits ^ flip
}
