//! Stable least-significant-digit radix sort of (`u32` key, `u32` value) pairs, any length.
//!
//! Each pass sorts by a few bits, in three steps: count the digits of each block, scan the counts
//! digit by digit over all blocks, move each pair to its position. On devices with planes of one
//! known size, ranks come from ballots, and lane d of a plane counts digit d in a register: as many
//! digits as lanes. Elsewhere, ranks come from per-unit counters in shared memory, scanned in the
//! order (digit, unit). Both give the unique order of a stable sort.
//!
//! Floor per pair and pass: 12 bytes read (the key twice), 8 written.

use cubecl::prelude::*;

use crate::bytes::{Bytes, Sizes};
use crate::launch::{Buffer, cube_count, per_element};
use crate::planes::plane_size;
use crate::scan::{cube_exclusive_sum, exclusive_sum};
use splat_core::TILE_SIDE;

/// Units per workgroup: 16 counters each fit well into the 16 KiB of shared memory that every
/// device has.
const UNITS: u32 = 128;
const UNITS_USIZE: usize = UNITS as usize;
/// Pairs per unit.
const ITEMS: usize = 16;
const BLOCK: usize = UNITS_USIZE * ITEMS;
/// Bits per digit without planes.
const SHARED_DIGIT_BITS: usize = 4;

/// Ranking method.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Ranking {
    /// Lanes of a plane; 1 without plane operations.
    lanes: usize,
}

impl Ranking {
    fn new(client: &Client) -> Self {
        Self {
            lanes: plane_size(client).unwrap_or(1),
        }
    }

    fn digit_bits(self) -> usize {
        match self.lanes {
            1 => SHARED_DIGIT_BITS,
            lanes => lanes.ilog2() as usize,
        }
    }

    /// Number of digits: as many as lanes with planes.
    fn digits(self) -> usize {
        1 << self.digit_bits()
    }

    /// Parts of a block whose digits are counted separately: planes or units.
    fn parts(self) -> usize {
        UNITS_USIZE / self.lanes
    }
}

/// Bin of `key` in the pass at `shift`; `mask` excludes bits that are not sorted by.
#[cube]
fn digit_of(key: u32, shift: u32, mask: u32) -> u32 {
    (key >> shift) & mask
}

/// `counts[digit * blocks + block]` = keys of `block` with that digit. `len[at]` is the number of
/// pairs, limited by `most`.
#[cube(launch)]
fn count_digits(
    keys: &[u32],
    len: &[u32],
    counts: &mut [u32],
    at: u32,
    most: u32,
    blocks: u32,
    shift: u32,
    mask: u32,
    #[comptime] digits: usize,
) {
    let histogram = Shared::<[Atomic<u32>]>::new_slice(digits);
    let unit = UNIT_POS as usize;
    let len = min(len[at as usize], most) as usize;
    if unit < digits {
        Atomic::store(&histogram[unit], 0u32);
    }
    sync_cube();
    for item in 0..ITEMS {
        let at = CUBE_POS * BLOCK + item * UNITS_USIZE + unit;
        if at < len {
            Atomic::fetch_add(&histogram[digit_of(keys[at], shift, mask) as usize], 1u32);
        }
    }
    sync_cube();
    if unit < digits && CUBE_POS < blocks as usize {
        counts[unit * blocks as usize + CUBE_POS] = Atomic::load(&histogram[unit]);
    }
}

/// Position of a unit's item in the keys. Without planes a unit takes consecutive pairs; the lanes
/// of a plane take adjacent pairs.
#[cube]
fn place(item: usize, #[comptime] ranking: Ranking) -> usize {
    let lanes = comptime!(ranking.lanes);
    let unit = UNIT_POS as usize;
    CUBE_POS * BLOCK + unit / lanes * (ITEMS * lanes) + item * lanes + unit % lanes
}

/// Lanes of a plane that have `digit`, from the lanes that have each of its bits set.
#[cube]
fn lanes_with(digit: u32, ballots: &Array<u32>, valid: u32, #[comptime] bits: usize) -> u32 {
    let mut lanes = valid;
    #[unroll]
    for bit in 0..bits {
        let set = (digit >> bit as u32) & 1u32 == 1u32;
        lanes &= select(set, ballots[bit], !ballots[bit]);
    }
    lanes
}

/// Ranks of a unit's pairs among those of the same digit in its plane, and the count in the plane
/// of the digit equal to the unit's lane. All units of a plane must call it together.
#[cube]
fn rank_by_planes(
    keys: &[u32],
    ranks: &mut Array<u32>,
    len: usize,
    shift: u32,
    mask: u32,
    #[comptime] ranking: Ranking,
) -> u32 {
    let bits = comptime!(ranking.digit_bits());
    let lanes = comptime!(ranking.lanes);
    let lane = UNIT_POS % lanes as u32;
    let mut low = Array::<u32>::new(bits);
    let mut high = Array::<u32>::new(bits);
    // Lanes before this one.
    let before_low = select(lane < 32u32, (1u32 << (lane % 32u32)) - 1u32, u32::MAX);
    let before_high = select(lane < 32u32, 0u32, (1u32 << (lane % 32u32)) - 1u32);
    let mut counted = 0u32;
    #[unroll]
    for item in 0..ITEMS {
        let at = place(item, ranking);
        let inside = at < len;
        let digit = digit_of(keys[select(inside, at, 0)], shift, mask);
        let valid = plane_ballot(inside);
        #[unroll]
        for bit in 0..bits {
            let ballot = plane_ballot((digit >> bit as u32) & 1u32 == 1u32);
            low[bit] = ballot.extract(0usize);
            high[bit] = ballot.extract(1usize);
        }
        let same = lanes_with(digit, &low, valid.extract(0usize), bits);
        let mine = lanes_with(lane, &low, valid.extract(0usize), bits);
        let mut rank = (same & before_low).count_ones();
        let mut more = mine.count_ones();
        if comptime!(lanes > 32) {
            let same = lanes_with(digit, &high, valid.extract(1usize), bits);
            let mine = lanes_with(lane, &high, valid.extract(1usize), bits);
            rank += (same & before_high).count_ones();
            more += mine.count_ones();
        }
        // The count of a digit so far is held by the lane of that number.
        ranks[item] = plane_shuffle(counted, digit) + rank;
        counted += more;
    }
    counted
}

/// Moves each pair to `starts[digit, block]` plus its rank among the block's pairs with that digit.
/// `len[at]` is the number of pairs, limited by `most`.
#[cube(launch)]
fn scatter(
    keys: &[u32],
    values: &[u32],
    len: &[u32],
    starts: &[u32],
    keys_out: &mut [u32],
    values_out: &mut [u32],
    at: u32,
    most: u32,
    blocks: u32,
    shift: u32,
    mask: u32,
    #[comptime] ranking: Ranking,
) {
    let digits = comptime!(ranking.digits());
    let parts = comptime!(ranking.parts());
    let lanes = comptime!(ranking.lanes);
    // For each digit and part: first the count there, then the count in the block before it.
    let mut before = Shared::new_slice(comptime!(digits * parts));
    let mut shared = Shared::new_slice(UNITS_USIZE);
    // Count in the block of all lower digits.
    let mut lower = Shared::new_slice(digits);
    let unit = UNIT_POS as usize;
    let part = unit / lanes;
    let len = min(len[at as usize], most) as usize;

    let mut ranks = Array::<u32>::new(ITEMS);
    if comptime!(lanes == 1) {
        for digit in 0..digits {
            before[digit * parts + part] = 0u32;
        }
        for item in 0..ITEMS {
            let at = place(item, ranking);
            if at < len {
                let digit = digit_of(keys[at], shift, mask) as usize;
                before[digit * parts + part] += 1u32;
            }
        }
    } else {
        let counted = rank_by_planes(keys, &mut ranks, len, shift, mask, ranking);
        before[unit % lanes * parts + part] = counted;
    }
    sync_cube();

    // Scan of all counters; each unit takes consecutive ones.
    let share = comptime!((digits * parts).div_ceil(UNITS_USIZE));
    let mut sum = 0u32;
    for k in 0..share {
        if unit * share + k < comptime!(digits * parts) {
            sum += before[unit * share + k];
        }
    }
    let (start, _total) = cube_exclusive_sum(sum, &mut shared, UNITS_USIZE);
    let mut running = start;
    for k in 0..share {
        if unit * share + k < comptime!(digits * parts) {
            let count = before[unit * share + k];
            before[unit * share + k] = running;
            running += count;
        }
    }
    sync_cube();
    if unit < digits {
        lower[unit] = before[unit * parts];
    }
    sync_cube();

    #[unroll(comptime!(lanes > 1))]
    for item in 0..ITEMS {
        let from = place(item, ranking);
        if from < len {
            let key = keys[from];
            let digit = digit_of(key, shift, mask) as usize;
            let counter = digit * parts + part;
            let mut rank = before[counter] - lower[digit];
            if comptime!(lanes == 1) {
                before[counter] += 1u32;
            } else {
                rank += ranks[item];
            }
            let to = starts[digit * blocks as usize + CUBE_POS] + rank;
            keys_out[to as usize] = key;
            values_out[to as usize] = values[from];
        }
    }
}

/// Bits per pass on the client's device.
pub fn digit_bits(client: &Client) -> u32 {
    Ranking::new(client).digit_bits() as u32
}

/// Ranking method of this device, in words.
pub fn variant(client: &Client) -> String {
    let ranking = Ranking::new(client);
    let ranks = match ranking.lanes {
        1 => "counters of every unit in shared memory",
        _ => "ballots",
    };
    format!("{} bits a pass, ranks from {ranks}", ranking.digit_bits())
}

/// Floor of the two sorts of a view: the visible splats by depth, then the intersections by tile.
pub(crate) fn floor(sizes: &Sizes) -> Bytes {
    let tile = TILE_SIDE as u64;
    let tiles = sizes.width.div_ceil(tile) * sizes.height.div_ceil(tile);
    let passes = |bits: u32| u64::from(bits.div_ceil(sizes.digit_bits.max(1)));
    let pairs =
        sizes.visible * passes(32) + sizes.intersections * passes(bits_for(tiles as usize + 1));
    Bytes {
        read: 12 * pairs,
        written: 8 * pairs,
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

/// Sorts the pairs by the lowest `key_bits` bits of their keys, ascending and stably. Pairs without
/// a partner (one buffer longer than the other) are dropped.
pub fn sort_pairs(
    client: &Client,
    keys: &Buffer,
    values: &Buffer,
    key_bits: u32,
) -> (Buffer, Buffer) {
    let len = keys.len().min(values.len());
    let count = Buffer::from_u32(client, &[len as u32]);
    sort_first_pairs(client, keys, values, (&count, 0), key_bits)
}

/// Sorts the first pairs; element `count.1` of `count.0` says how many. Results past them are
/// undefined. The host need not know the number.
pub(crate) fn sort_first_pairs(
    client: &Client,
    keys: &Buffer,
    values: &Buffer,
    count: (&Buffer, u32),
    key_bits: u32,
) -> (Buffer, Buffer) {
    let most = keys.len().min(values.len());
    let (mut keys, mut values) = (keys.clone(), values.clone());
    if most == 0 {
        return (Buffer::empty(client, 0), Buffer::empty(client, 0));
    }
    let ranking = Ranking::new(client);
    let digit_bits = ranking.digit_bits() as u32;
    let blocks = most.div_ceil(BLOCK);
    let dim = CubeDim::new_1d(UNITS);
    let mut shift = 0;
    let key_bits = key_bits.min(32);
    while shift < key_bits {
        let mask = (1 << digit_bits.min(key_bits - shift)) - 1;
        let counts = Buffer::empty(client, ranking.digits() * blocks);
        count_digits::launch(
            client,
            cube_count(blocks),
            dim,
            keys.arg(),
            count.0.arg(),
            counts.arg(),
            count.1,
            most as u32,
            blocks as u32,
            shift,
            mask,
            ranking.digits(),
        );
        let starts = exclusive_sum(client, &counts);
        let keys_out = Buffer::empty(client, most);
        let values_out = Buffer::empty(client, most);
        scatter::launch(
            client,
            cube_count(blocks),
            dim,
            keys.arg(),
            values.arg(),
            count.0.arg(),
            starts.arg(),
            keys_out.arg(),
            values_out.arg(),
            count.1,
            most as u32,
            blocks as u32,
            shift,
            mask,
            ranking,
        );
        (keys, values) = (keys_out, values_out);
        shift += digit_bits;
    }
    (keys, values)
}

/// Bits needed for numbers below `count`.
pub fn bits_for(count: usize) -> u32 {
    usize::BITS - count.saturating_sub(1).leading_zeros()
}

/// The bits of a float, mapped so that unsigned order is numerical order: negative numbers have all
/// bits flipped, others only the sign. -0 counts as 0.
#[cube]
pub(crate) fn ordered_bits(value: f32) -> u32 {
    let mut bits = u32::reinterpret(value);
    if bits == 0x8000_0000u32 {
        bits = 0u32;
    }
    let flip = select(bits >> 31u32 == 1u32, 0xffff_ffffu32, 0x8000_0000u32);
    bits ^ flip
}
