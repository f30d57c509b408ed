//! Kernels that build the lists.

use cubecl::prelude::*;
use splat_core::{PROJECTED_DEPTH, PROJECTED_WIDTH};

use super::Grid;
use super::footprint::{Footprint, Reach, footprint};
use crate::launch::{CUBE_UNITS, CUBE_UNITS_USIZE};
use crate::scan::cube_exclusive_sum;
use crate::sort::ordered_bits;

/// Most tiles in the bounding box of a splat that a single unit tests.
const WIDE: u32 = 64;

/// 1 for each visible splat, whose bounding box meets the image.
#[cube(launch)]
pub(super) fn find_visible(packed: &[f32], opacities: &[f32], visible: &mut [u32], grid: Grid) {
    let splat = ABSOLUTE_POS;
    if splat <= grid.splats as usize {
        let mut found = 0u32;
        if splat < grid.splats as usize {
            let f = footprint(packed, opacities, splat, grid.alpha_min);
            found = select(Reach::new(f, grid).tiles > 0u32, 1u32, 0u32);
        }
        visible[splat] = found;
    }
}

/// Depth keys and indices of the visible splats, in index order.
#[cube(launch)]
pub(super) fn pack_visible(
    packed: &[f32],
    visible: &[u32],
    keys: &mut [u32],
    indices: &mut [u32],
    splats: u32,
) {
    let splat = ABSOLUTE_POS;
    if splat < splats as usize {
        let to = visible[splat];
        if visible[splat + 1] > to {
            keys[to as usize] = ordered_bits(packed[splat * PROJECTED_WIDTH + PROJECTED_DEPTH]);
            indices[to as usize] = splat as u32;
        }
    }
}

/// Writes an intersection to its slot, unless the slot belongs to another splat.
#[cube]
fn emit_intersection(
    keys: &mut [u32],
    slots: &mut [u32],
    slot_splats: &mut [u32],
    slot: u32,
    end: u32,
    tile: u32,
    splat: u32,
) {
    if slot < end {
        keys[slot as usize] = tile;
        slots[slot as usize] = slot;
        slot_splats[slot as usize] = splat;
    }
}

/// Counting and emitting are two compilations of one function. Should a compiler round them
/// differently, leftover slots go to no tile.
#[cube]
fn emit_nothing(
    keys: &mut [u32],
    slots: &mut [u32],
    slot_splats: &mut [u32],
    slot: u32,
    end: u32,
    splat: u32,
    grid: Grid,
) {
    let mut slot = slot;
    while slot < end {
        emit_intersection(keys, slots, slot_splats, slot, end, grid.tiles, splat);
        slot += 1u32;
    }
}

/// Tests the tiles of a splat with one unit; see [`walk_tiles`].
#[cube]
fn walk_narrow(
    f: Footprint,
    reach: Reach,
    splat: u32,
    j: usize,
    offsets: &mut [u32],
    keys: &mut [u32],
    slots: &mut [u32],
    slot_splats: &mut [u32],
    grid: Grid,
    capacity: u32,
    #[comptime] emit: bool,
) {
    let first_tile = splat / grid.gaussians * grid.columns * grid.rows;
    let mut slot = 0u32;
    let mut end = 0u32;
    if comptime!(emit) {
        slot = offsets[j];
        end = min(offsets[j + 1], capacity);
    }
    for i in 0..reach.tiles {
        let (tile, touched) = reach.tile(f, i, grid);
        if touched {
            if comptime!(emit) {
                let tile = first_tile + tile;
                emit_intersection(keys, slots, slot_splats, slot, end, tile, splat);
            }
            slot += 1u32;
        }
    }
    if comptime!(emit) {
        emit_nothing(keys, slots, slot_splats, slot, end, splat, grid);
    } else {
        offsets[j] = slot;
    }
}

/// Tests the tiles of a splat with all units of the workgroup; see [`walk_tiles`].
#[cube]
fn walk_wide(
    f: Footprint,
    reach: Reach,
    splat: u32,
    j: usize,
    tiles: u32,
    offsets: &mut [u32],
    keys: &mut [u32],
    slots: &mut [u32],
    slot_splats: &mut [u32],
    grid: Grid,
    capacity: u32,
    shared: &mut Shared<[u32]>,
    #[comptime] emit: bool,
) {
    let first_tile = splat / grid.gaussians * grid.columns * grid.rows;
    let mut touched_here = 0u32;
    let mut slot = 0u32;
    let mut end = 0u32;
    if comptime!(emit) {
        slot = offsets[j];
        end = min(offsets[j + 1], capacity);
    }
    let mut first = 0u32;
    while first < tiles {
        let (tile, touched) = reach.tile(f, first + UNIT_POS, grid);
        let one = select(touched, 1u32, 0u32);
        if comptime!(emit) {
            let (before, total) = cube_exclusive_sum(one, shared, CUBE_UNITS_USIZE);
            if touched {
                let (slot, tile) = (slot + before, first_tile + tile);
                emit_intersection(keys, slots, slot_splats, slot, end, tile, splat);
            }
            slot += total;
        } else {
            touched_here += one;
        }
        first += CUBE_UNITS;
    }
    if comptime!(emit) {
        if UNIT_POS == 0 {
            emit_nothing(keys, slots, slot_splats, slot, end, splat, grid);
        }
    } else {
        let (_before, total) = cube_exclusive_sum(touched_here, shared, CUBE_UNITS_USIZE);
        if UNIT_POS == 0 {
            offsets[j] = total;
        }
    }
}

/// Tiles touched by the j-th splat of `order`. When counting, `offsets[j]` is their number, and 0
/// past the last splat. When emitting, writes their keys (tile index over all cameras), slots and
/// splats from slot `offsets[j]` on, up to slot `capacity`.
#[cube(launch)]
pub(super) fn walk_tiles(
    packed: &[f32],
    opacities: &[f32],
    visible: &[u32],
    order: &[u32],
    offsets: &mut [u32],
    keys: &mut [u32],
    slots: &mut [u32],
    slot_splats: &mut [u32],
    grid: Grid,
    capacity: u32,
    #[comptime] emit: bool,
) {
    // Wide splats of the workgroup and the tiles of their boxes.
    let mut wide = Shared::new_slice(CUBE_UNITS_USIZE);
    let mut wide_tiles = Shared::new_slice(CUBE_UNITS_USIZE);
    let mut wide_count = Shared::new_slice(1usize);
    let mut shared = Shared::new_slice(CUBE_UNITS_USIZE);
    let j = ABSOLUTE_POS as u32;
    let mut tiles = 0u32;
    if j < visible[grid.splats as usize] {
        let splat = order[j as usize];
        let f = footprint(packed, opacities, splat as usize, grid.alpha_min);
        let reach = Reach::new(f, grid);
        tiles = reach.tiles;
        if tiles <= WIDE {
            walk_narrow(
                f,
                reach,
                splat,
                j as usize,
                offsets,
                keys,
                slots,
                slot_splats,
                grid,
                capacity,
                emit,
            );
        }
    } else if j <= grid.splats {
        if comptime!(!emit) {
            offsets[j as usize] = 0u32;
        }
    }

    let is_wide = tiles > WIDE;
    let one = select(is_wide, 1u32, 0u32);
    let (place, count) = cube_exclusive_sum(one, &mut shared, CUBE_UNITS_USIZE);
    if is_wide {
        wide[place as usize] = j;
        wide_tiles[place as usize] = tiles;
    }
    if UNIT_POS == 0 {
        wide_count[0] = count;
    }
    // Wide splats one by one, each by all units.
    let count = workgroup_uniform_load(&wide_count[0]);
    for entry in 0..count {
        let j = workgroup_uniform_load(&wide[entry as usize]) as usize;
        let tiles = workgroup_uniform_load(&wide_tiles[entry as usize]);
        let splat = order[j];
        let f = footprint(packed, opacities, splat as usize, grid.alpha_min);
        let reach = Reach::new(f, grid);
        walk_wide(
            f,
            reach,
            splat,
            j,
            tiles,
            offsets,
            keys,
            slots,
            slot_splats,
            grid,
            capacity,
            &mut shared,
            emit,
        );
    }
}

/// First position in the ascending `keys` whose key is at least `key`.
#[cube]
fn lower_bound(keys: &[u32], len: u32, key: u32) -> u32 {
    let mut low = 0u32;
    let mut high = len;
    while low < high {
        let middle = (low + high) / 2u32;
        if keys[middle as usize] < key {
            low = middle + 1u32;
        } else {
            high = middle;
        }
    }
    low
}

/// Number of intersections: `counted[at]` on the device, limited by `capacity`.
#[cube]
fn intersections_listed(counted: &[u32], at: u32, capacity: u32) -> u32 {
    min(counted[at as usize], capacity)
}

/// Range of intersections of every tile, including empty ones.
#[cube(launch)]
pub(super) fn tile_ranges(
    keys: &[u32],
    counted: &[u32],
    ranges: &mut [u32],
    at: u32,
    capacity: u32,
    tiles: u32,
) {
    let tile = ABSOLUTE_POS;
    if tile < tiles as usize {
        let intersections = intersections_listed(counted, at, capacity);
        ranges[tile * 2] = lower_bound(keys, intersections, tile as u32);
        ranges[tile * 2 + 1] = lower_bound(keys, intersections, tile as u32 + 1u32);
    }
}

/// `out[i] = table[indices[i]]` for each intersection.
#[cube(launch)]
pub(super) fn gather(
    indices: &[u32],
    table: &[u32],
    counted: &[u32],
    out: &mut [u32],
    at: u32,
    capacity: u32,
) {
    if ABSOLUTE_POS < intersections_listed(counted, at, capacity) as usize {
        out[ABSOLUTE_POS] = table[indices[ABSOLUTE_POS] as usize];
    }
}
