//! Prefix sums of `u32`, any length, modulo 2^32.
//!
//! Three steps: each workgroup sums its block; the block sums are scanned recursively; each
//! workgroup scans its block again from its block's start. Sums are of integers, so the order does
//! not matter.
//!
//! Floor per element: 8 bytes read (each is read twice), 4 written, 3 additions.

use cubecl::prelude::*;

use crate::launch::{Buffer, CUBE_UNITS, CUBE_UNITS_USIZE, PendingRead, cube_count};

/// Consecutive elements per unit.
const ITEMS: usize = 8;
/// Elements per workgroup.
pub(crate) const BLOCK: usize = CUBE_UNITS_USIZE * ITEMS;

/// Exclusive prefix sum over the `units` of a workgroup, and the total. All units must call it;
/// `shared` holds one value per unit.
#[cube]
pub(crate) fn cube_exclusive_sum(
    value: u32,
    shared: &mut [u32],
    #[comptime] units: usize,
) -> (u32, u32) {
    let unit = UNIT_POS as usize;
    shared[unit] = value;
    sync_cube();
    let mut inclusive = value;
    let mut step = 1usize;
    while step < units {
        if unit >= step {
            inclusive += shared[unit - step];
        }
        sync_cube();
        shared[unit] = inclusive;
        sync_cube();
        step *= 2;
    }
    let total = shared[units - 1];
    sync_cube();
    (inclusive - value, total)
}

/// `sums[b]` = sum of block `b` of `input`.
#[cube(launch)]
fn block_sums(input: &[u32], sums: &mut [u32], len: u32, blocks: u32) {
    let mut shared = Shared::new_slice(CUBE_UNITS_USIZE);
    let first = CUBE_POS * BLOCK + UNIT_POS as usize * ITEMS;
    let mut sum = 0u32;
    for item in 0..ITEMS {
        if first + item < len as usize {
            sum += input[first + item];
        }
    }
    let (_before, total) = cube_exclusive_sum(sum, &mut shared, CUBE_UNITS_USIZE);
    if UNIT_POS == 0 && CUBE_POS < blocks as usize {
        sums[CUBE_POS] = total;
    }
}

/// Scans each block of `input`, starting from `starts[block]` (from 0 if there is only one block).
#[cube(launch)]
fn scan_blocks(
    input: &[u32],
    starts: &[u32],
    output: &mut [u32],
    len: u32,
    blocks: u32,
    #[comptime] inclusive: bool,
) {
    let mut shared = Shared::new_slice(CUBE_UNITS_USIZE);
    let first = CUBE_POS * BLOCK + UNIT_POS as usize * ITEMS;
    let mut sum = 0u32;
    for item in 0..ITEMS {
        if first + item < len as usize {
            sum += input[first + item];
        }
    }
    let (before, _total) = cube_exclusive_sum(sum, &mut shared, CUBE_UNITS_USIZE);
    let mut running = before;
    if blocks > 1 && CUBE_POS < blocks as usize {
        running += starts[CUBE_POS];
    }
    for item in 0..ITEMS {
        if first + item < len as usize {
            let value = input[first + item];
            if comptime!(inclusive) {
                output[first + item] = running + value;
            } else {
                output[first + item] = running;
            }
            running += value;
        }
    }
}

fn sum_blocks(client: &Client, input: &Buffer) -> Buffer {
    let blocks = input.len().div_ceil(BLOCK);
    let sums = Buffer::empty(client, blocks);
    if blocks > 0 {
        block_sums::launch(
            client,
            cube_count(blocks),
            CubeDim::new_1d(CUBE_UNITS),
            input.arg(),
            sums.arg(),
            input.len() as u32,
            blocks as u32,
        );
    }
    sums
}

fn scan(client: &Client, input: &Buffer, block_sums: Option<&Buffer>, inclusive: bool) -> Buffer {
    let output = Buffer::empty(client, input.len());
    let blocks = input.len().div_ceil(BLOCK);
    if blocks == 0 {
        return output;
    }
    let starts = if blocks > 1 {
        let sums = match block_sums {
            Some(sums) => sums.clone(),
            None => sum_blocks(client, input),
        };
        scan(client, &sums, None, false)
    } else {
        Buffer::empty(client, 1)
    };
    scan_blocks::launch(
        client,
        cube_count(blocks),
        CubeDim::new_1d(CUBE_UNITS),
        input.arg(),
        starts.arg(),
        output.arg(),
        input.len() as u32,
        blocks as u32,
        inclusive,
    );
    output
}

/// `output[i]` = sum of `input[0..i]`.
pub fn exclusive_sum(client: &Client, input: &Buffer) -> Buffer {
    scan(client, input, None, false)
}

/// `output[i]` = sum of `input[0..=i]`.
pub fn inclusive_sum(client: &Client, input: &Buffer) -> Buffer {
    scan(client, input, None, true)
}

/// A total being copied to the host.
pub struct PendingTotal<'a>(Option<PendingRead<'a>>);

impl PendingTotal<'_> {
    /// Waits for the total.
    ///
    /// # Errors
    /// The device's error, in words.
    pub fn wait(self) -> Result<u64, String> {
        let Some(read) = self.0 else { return Ok(0) };
        let sums = read.wait()?;
        Ok(u32::from_bytes(&sums)
            .iter()
            .map(|&sum| u64::from(sum))
            .sum())
    }
}

/// The exclusive sum, and the total of all elements without overflow: the block sums are read back
/// and added in 64 bits (2,048 elements share one sum, so elements up to 2^21 are safe). Does not
/// wait for the device: work launched before [`PendingTotal::wait`] overlaps the copy.
pub fn exclusive_sum_with_total<'a>(
    client: &'a Client,
    input: &Buffer,
) -> (Buffer, PendingTotal<'a>) {
    let sums = sum_blocks(client, input);
    let total = (!sums.is_empty()).then(|| sums.start_reading(client));
    let output = scan(client, input, Some(&sums), false);
    (output, PendingTotal(total))
}
