//! Which splats touch which tiles, front to back (3DGS section 6).
//!
//! Visible splats are packed together in the order of their index and sorted by depth (equal depths by index); each
//! emits the tiles it touches in that order; a stable sort by tile then leaves the list of every tile in depth order. An
//! *instance* is one (splat, tile) pair, its *slot* its place in the order of emission: the slots of one splat are
//! consecutive, so that gradients that were written to slots can be summed splat by splat, in order.
//!
//! A splat touches a tile iff the ellipse `opacity exp(-sigma) >= alpha_min` meets the rectangle of the tile's pixel
//! centres: sigma is convex, so unless its centre lies in the rectangle its minimum lies on an edge that faces it. One
//! unit tries the tiles of one splat; those of a splat over more than 64 tiles are shared out to its workgroup.
//!
//! Floor: 28 bytes per splat read and 8 written per visible one; then per visible splat 32 bytes twice (counting and
//! emitting) and some 40 operations per tile of its bounding box; 12 bytes written per instance, and read again after the
//! sort.

use std::fmt;

use cubecl::prelude::*;
use splat_core::{PROJECTED_DEPTH, PROJECTED_EXTENT, PROJECTED_WIDTH, TILE_SIDE};

use crate::floor::{Bytes, Sizes};
use crate::launch::{Buffer, CUBE_UNITS, CUBE_UNITS_USIZE, per_element};
use crate::math::is_finite;
use crate::rasterize::MAX_SLOT_VALUES;
use crate::scan::{PendingTotal, cube_exclusive_sum, exclusive_sum, exclusive_sum_with_total};
use crate::sort::{bits_for, ordered_bits, sort_first_pairs};
use crate::work;

/// Side of a tile in pixels.
pub const TILE: u32 = TILE_SIDE as u32;

/// Most tiles in the bounding box of a splat whose tiles are tried by one unit.
const WIDE: u32 = 64;

/// The images that are rendered together.
#[derive(Clone, Copy, Debug)]
pub struct Frames {
    /// C, number of cameras.
    pub cameras: usize,
    /// N, Gaussians per camera.
    pub gaussians: usize,
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Alpha below which a splat is not seen.
    pub alpha_min: f32,
}

impl Frames {
    /// Tiles of all images.
    pub fn tiles(&self) -> usize {
        self.cameras * self.width.div_ceil(TILE) as usize * self.height.div_ceil(TILE) as usize
    }

    /// Screen splats of all cameras.
    pub fn splats(&self) -> usize {
        self.cameras * self.gaussians
    }

    pub(crate) fn uniforms(&self) -> GridLaunch {
        GridLaunch::new(
            self.gaussians as u32,
            self.splats() as u32,
            self.tiles() as u32,
            self.width,
            self.height,
            self.width.div_ceil(TILE),
            self.height.div_ceil(TILE),
            self.alpha_min,
        )
    }
}

/// [`Frames`] on the device.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(crate) struct Grid {
    pub gaussians: u32,
    pub splats: u32,
    /// Tiles of all cameras.
    pub tiles: u32,
    pub width: u32,
    pub height: u32,
    pub columns: u32,
    pub rows: u32,
    pub alpha_min: f32,
}

/// The lists of all tiles of all cameras.
#[derive(Clone, Debug)]
pub struct TileLists {
    /// Number of instances.
    pub instances: usize,
    /// Splat (camera N + Gaussian) of every instance, by tile, front to back; there may be room for more.
    pub splats: Buffer,
    /// First instance and end of every tile [tiles, 2].
    pub ranges: Buffer,
    /// Only sums in order need them.
    pub slots: Option<Slots>,
}

/// A slot for every instance, those of one splat side by side.
#[derive(Clone, Debug)]
pub struct Slots {
    /// Slot of every instance, in the order of the tiles' lists.
    pub of: Buffer,
    /// How many splats of a lower index are visible; at the end how many there are, V [splats + 1].
    pub visible: Buffer,
    /// The visible splats, front to back: V of them, in memory for all.
    pub order: Buffer,
    /// `offsets[j]..offsets[j + 1]`: the slots of splat `order[j]`, for j < V of [splats + 1].
    pub offsets: Buffer,
}

/// Why there are no tile lists.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum IntersectError {
    /// More (splat, tile) pairs than can be indexed, or than a buffer of the device can hold.
    TooManyInstances {
        /// How many there are.
        count: u64,
        /// How many can be listed.
        limit: u64,
    },
    /// The device failed, in its words.
    Device(String),
}

impl fmt::Display for IntersectError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooManyInstances { count, limit } => write!(
                f,
                "{count} pairs of a splat and a tile that it touches; at most {limit} can be rendered at once"
            ),
            Self::Device(error) => write!(f, "the device failed: {error}"),
        }
    }
}

impl std::error::Error for IntersectError {}

/// Instances that can be listed: kernels address memory by 32-bit indices, and the backward pass keeps up to
/// [`MAX_SLOT_VALUES`] floats per instance.
pub const MAX_INSTANCES: u64 = u32::MAX as u64 / MAX_SLOT_VALUES as u64;

/// Instances that a device can list: each is one number in each of several buffers, whose size the device limits.
fn max_instances(client: &Client) -> u64 {
    let largest_buffer = client.properties().memory.max_page_size;
    MAX_INSTANCES.min(largest_buffer / size_of::<u32>() as u64)
}

/// The one place that decides how many instances are too many. Asked before any list is allocated.
fn check_instances(count: u64, limit: u64) -> Result<usize, IntersectError> {
    match usize::try_from(count) {
        Ok(instances) if count <= limit => Ok(instances),
        _ => Err(IntersectError::TooManyInstances { count, limit }),
    }
}

/// The part of a splat that can be seen: the ellipse sigma <= `cut`.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(crate) struct Footprint {
    /// Whether there is one, of finite size.
    seen: bool,
    mean_x: f32,
    mean_y: f32,
    w11: f32,
    w21: f32,
    w22: f32,
    /// ln(opacity / alpha_min), a little widened: rounding must never drop a pixel.
    cut: f32,
    /// Half size of the ellipse's bounding box.
    half_x: f32,
    half_y: f32,
}

#[cube]
impl Footprint {
    pub fn new(
        mean_x: f32,
        mean_y: f32,
        w11: f32,
        w21: f32,
        w22: f32,
        opacity: f32,
        alpha_min: f32,
    ) -> Footprint {
        let ratio = opacity / alpha_min;
        let cut = f32::ln(ratio) * 1.0001f32 + 1e-4f32;
        // Standard deviations along x and y: L = W⁻¹ has l11 = 1/w11, l21 = -w21/(w11 w22), l22 = 1/w22.
        let reach = f32::sqrt(2.0f32 * cut);
        let half_x = reach / w11;
        let slope = w21 / w11;
        let half_y = reach * f32::sqrt(1.0f32 + slope * slope) / w22;
        let finite = is_finite(ratio)
            && is_finite(mean_x)
            && is_finite(mean_y)
            && is_finite(half_x)
            && is_finite(half_y);
        Footprint {
            seen: finite && opacity >= alpha_min,
            mean_x,
            mean_y,
            w11,
            w21,
            w22,
            cut,
            half_x,
            half_y,
        }
    }

    /// Whether the ellipse meets the rectangle of the centres of pixels `x..end_x`, `y..end_y`.
    pub fn touches(self, x: u32, end_x: u32, y: u32, end_y: u32) -> bool {
        let dx0 = x as f32 + 0.5f32 - self.mean_x;
        let dy0 = y as f32 + 0.5f32 - self.mean_y;
        let dx1 = end_x as f32 - 0.5f32 - self.mean_x;
        let dy1 = end_y as f32 - 0.5f32 - self.mean_y;
        let beside = dx0 > 0.0f32 || dx1 < 0.0f32;
        let above = dy0 > 0.0f32 || dy1 < 0.0f32;
        // Lowest point of the facing vertical edge: dσ/ddy = 0 at dy = -w21 dx / w22.
        let edge_x = select(dx0 > 0.0f32, dx0, dx1);
        let on_x = min(max(-self.w21 * edge_x / self.w22, dy0), dy1);
        // Lowest point of the facing horizontal edge: dσ/ddx = 0 at dx = -w21 w22 dy / (w11² + w21²).
        let edge_y = select(dy0 > 0.0f32, dy0, dy1);
        let on_y = min(
            max(
                -self.w21 * self.w22 * edge_y / (self.w11 * self.w11 + self.w21 * self.w21),
                dx0,
            ),
            dx1,
        );
        let hit_x = beside && self.sigma_below(edge_x, on_x) <= self.cut;
        let hit_y = above && self.sigma_below(on_y, edge_y) <= self.cut;
        (!beside && !above) || hit_x || hit_y
    }

    /// A lower bound of sigma at (dx, dy) from the mean, below its rounding error for long and thin splats.
    fn sigma_below(self, dx: f32, dy: f32) -> f32 {
        let z1 = self.w11 * dx;
        let along = self.w21 * dx;
        let across = self.w22 * dy;
        let rounding = 1e-6f32 * (f32::abs(along) + f32::abs(across));
        let z2 = max(f32::abs(along + across) - rounding, 0.0f32);
        0.5f32 * (z1 * z1 + z2 * z2)
    }
}

/// The footprint of a splat, as it is in memory.
#[cube]
fn footprint(packed: &[f32], opacities: &[f32], splat: usize, alpha_min: f32) -> Footprint {
    let at = splat * PROJECTED_WIDTH;
    let mut f = Footprint::new(
        packed[at],
        packed[at + 1],
        packed[at + 3],
        packed[at + 4],
        packed[at + 5],
        opacities[splat],
        alpha_min,
    );
    f.seen = f.seen && packed[at + PROJECTED_EXTENT] > 0.0f32;
    f
}

/// First tile and end of those that the interval mean +- half reaches, of `count` in a row or column; half a pixel
/// and one part in 10,000 of slack.
#[cube]
fn tile_range(mean: f32, half: f32, count: u32) -> (u32, u32) {
    let reach = half * 1.0001f32 + 0.5f32;
    let tile = TILE as f32;
    let low = (mean - reach - 0.5f32) / tile;
    let high = (mean + reach - 0.5f32) / tile + 1.0f32;
    let limit = count as f32;
    (
        min(max(low, 0.0f32), limit) as u32,
        min(max(high, 0.0f32), limit) as u32,
    )
}

/// The tiles that a splat may touch: a rectangle.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
struct Reach {
    x: u32,
    y: u32,
    columns: u32,
    /// Tiles of the box; none if the splat is not seen.
    tiles: u32,
}

#[cube]
impl Reach {
    fn new(f: Footprint, grid: Grid) -> Reach {
        let (x, end_x) = tile_range(f.mean_x, f.half_x, grid.columns);
        let (y, end_y) = tile_range(f.mean_y, f.half_y, grid.rows);
        let columns = select(end_x > x, end_x - x, 0u32);
        let rows = select(end_y > y, end_y - y, 0u32);
        Reach {
            x,
            y,
            columns,
            tiles: select(f.seen, columns * rows, 0u32),
        }
    }

    /// The i-th tile of the box in its image, and whether the splat touches it.
    fn tile(self, f: Footprint, i: u32, grid: Grid) -> (u32, bool) {
        let columns = max(self.columns, 1u32);
        let column = self.x + i % columns;
        let row = self.y + i / columns;
        let (x, y) = (column * TILE, row * TILE);
        let end_x = min(x + TILE, grid.width);
        let end_y = min(y + TILE, grid.height);
        (
            row * grid.columns + column,
            i < self.tiles && f.touches(x, end_x, y, end_y),
        )
    }
}

/// 1 for every visible splat: one whose bounding box meets its image.
#[cube(launch)]
fn find_visible(packed: &[f32], opacities: &[f32], visible: &mut [u32], grid: Grid) {
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

/// Depth keys and indices of the visible splats, in the order of their index.
#[cube(launch)]
fn pack_visible(
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

/// An instance in its slot, unless the slot is another splat's.
#[cube]
fn emit_instance(
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

/// Counting and emitting are two compilations of one function. Should a compiler round them differently, the slots left
/// over go to no tile.
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
        emit_instance(keys, slots, slot_splats, slot, end, grid.tiles, splat);
        slot += 1u32;
    }
}

/// Tiles touched by the j-th splat of `order`. Counting: `offsets[j]` = their number, 0 behind the last splat. Emitting:
/// their keys (tile index over all cameras), slots and splats, from slot `offsets[j]` on; none from slot `capacity` on.
#[cube(launch)]
fn walk_tiles(
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
    // The wide splats of the workgroup and the tiles of their boxes.
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
            let first_tile = splat / grid.gaussians * grid.columns * grid.rows;
            let mut slot = 0u32;
            let mut end = 0u32;
            if comptime!(emit) {
                slot = offsets[j as usize];
                end = min(offsets[j as usize + 1], capacity);
            }
            for i in 0..tiles {
                let (tile, touched) = reach.tile(f, i, grid);
                if touched {
                    if comptime!(emit) {
                        let tile = first_tile + tile;
                        emit_instance(keys, slots, slot_splats, slot, end, tile, splat);
                    }
                    slot += 1u32;
                }
            }
            if comptime!(emit) {
                emit_nothing(keys, slots, slot_splats, slot, end, splat, grid);
            } else {
                offsets[j as usize] = slot;
            }
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
    // One after the other, each by all units.
    let count = workgroup_uniform_load(&wide_count[0]);
    for entry in 0..count {
        let j = workgroup_uniform_load(&wide[entry as usize]) as usize;
        let tiles = workgroup_uniform_load(&wide_tiles[entry as usize]);
        let splat = order[j];
        let f = footprint(packed, opacities, splat as usize, grid.alpha_min);
        let reach = Reach::new(f, grid);
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
                let (before, total) = cube_exclusive_sum(one, &mut shared, CUBE_UNITS_USIZE);
                if touched {
                    let (slot, tile) = (slot + before, first_tile + tile);
                    emit_instance(keys, slots, slot_splats, slot, end, tile, splat);
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
            let (_before, total) = cube_exclusive_sum(touched_here, &mut shared, CUBE_UNITS_USIZE);
            if UNIT_POS == 0 {
                offsets[j] = total;
            }
        }
    }
}

/// First position in the ascending `keys` whose key is not less than `key`.
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

/// Instances, of which the device knows `counted[at]` and there is room for `capacity`.
#[cube]
fn instances_listed(counted: &[u32], at: u32, capacity: u32) -> u32 {
    min(counted[at as usize], capacity)
}

/// Range of instances of every tile, empty ones too.
#[cube(launch)]
fn tile_ranges(
    keys: &[u32],
    counted: &[u32],
    ranges: &mut [u32],
    at: u32,
    capacity: u32,
    tiles: u32,
) {
    let tile = ABSOLUTE_POS;
    if tile < tiles as usize {
        let instances = instances_listed(counted, at, capacity);
        ranges[tile * 2] = lower_bound(keys, instances, tile as u32);
        ranges[tile * 2 + 1] = lower_bound(keys, instances, tile as u32 + 1u32);
    }
}

/// `out[i] = table[indices[i]]` for every instance.
#[cube(launch)]
fn gather(
    indices: &[u32],
    table: &[u32],
    counted: &[u32],
    out: &mut [u32],
    at: u32,
    capacity: u32,
) {
    if ABSOLUTE_POS < instances_listed(counted, at, capacity) as usize {
        out[ABSOLUTE_POS] = table[indices[ABSOLUTE_POS] as usize];
    }
}

/// What listing must move for one camera, but for the sorts.
pub(crate) fn floor(sizes: &Sizes) -> Bytes {
    Bytes {
        read: 28 * sizes.gaussians + 64 * sizes.visible + 12 * sizes.instances,
        written: 8 * sizes.visible + 12 * sizes.instances,
    }
}

/// Lists the splats of every tile: `packed` [C, N, 9], `opacities` [C, N]. Waits for the device once, to learn the
/// number of instances.
///
/// # Errors
/// More instances than can be indexed or than a buffer of the device holds, or a failing device.
pub fn intersect(
    client: &Client,
    packed: &Buffer,
    opacities: &Buffer,
    frames: &Frames,
) -> Result<TileLists, IntersectError> {
    let (counted, total) = Counted::new(client, packed, opacities, frames);
    let instances = wait_for_instances(client, total)?;
    Ok(counted.list(client, instances))
}

/// Lists the splats of every tile as [`intersect`] does, and hands the lists to `then`, without a pause of the device:
/// room is made for somewhat more instances than there were lately, and the number is looked at when all is under way.
/// Only if there were more is everything done once more.
pub(crate) fn intersect_ahead<R>(
    client: &Client,
    packed: &Buffer,
    opacities: &Buffer,
    frames: &Frames,
    then: impl Fn(&TileLists) -> R,
) -> Result<(TileLists, R), IntersectError> {
    let (counted, total) = Counted::new(client, packed, opacities, frames);
    let limit = max_instances(client) as usize;
    let ahead = room::expected().map(|capacity| {
        let capacity = capacity.min(limit);
        let lists = counted.list(client, capacity);
        let result = then(&lists);
        (lists, result)
    });
    let instances = wait_for_instances(client, total)?;
    room::found(instances);
    Ok(match ahead {
        Some((mut lists, result)) if instances <= lists.instances => {
            lists.instances = instances;
            (lists, result)
        }
        _ => {
            let lists = counted.list(client, instances);
            let result = then(&lists);
            (lists, result)
        }
    })
}

fn wait_for_instances(client: &Client, total: PendingTotal<'_>) -> Result<usize, IntersectError> {
    let count = total.wait().map_err(IntersectError::Device)?;
    let instances = check_instances(count, max_instances(client))?;
    work::listed(instances);
    Ok(instances)
}

/// How many instances the next call may have. Lists of any capacity that suffices are the same, so that what happened
/// before never changes a result.
mod room {
    use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

    use super::MAX_INSTANCES;

    /// Largest number lately; less by and by.
    static LATELY: AtomicUsize = AtomicUsize::new(0);

    /// `None` before the first call.
    pub fn expected() -> Option<usize> {
        let lately = LATELY.load(Relaxed);
        (lately > 0).then(|| (lately + lately / 4).min(MAX_INSTANCES as usize))
    }

    pub fn found(instances: usize) {
        let lately = LATELY.load(Relaxed);
        LATELY.store(instances.max(lately - lately / 16), Relaxed);
    }
}

/// The visible splats in order, and where their slots begin: all that is known before there is memory for instances.
struct Counted<'a> {
    packed: &'a Buffer,
    opacities: &'a Buffer,
    frames: &'a Frames,
    visible: Buffer,
    order: Buffer,
    offsets: Buffer,
}

impl<'a> Counted<'a> {
    fn new(
        client: &'a Client,
        packed: &'a Buffer,
        opacities: &'a Buffer,
        frames: &'a Frames,
    ) -> (Self, PendingTotal<'a>) {
        let splats = frames.splats();
        let flags = Buffer::empty(client, splats + 1);
        if let Some((count, dim)) = per_element(splats + 1) {
            find_visible::launch(
                client,
                count,
                dim,
                packed.arg(),
                opacities.arg(),
                flags.arg(),
                frames.uniforms(),
            );
        }
        let visible = exclusive_sum(client, &flags);
        let depths = Buffer::empty(client, splats);
        let indices = Buffer::empty(client, splats);
        if let Some((count, dim)) = per_element(splats) {
            pack_visible::launch(
                client,
                count,
                dim,
                packed.arg(),
                visible.arg(),
                depths.arg(),
                indices.arg(),
                splats as u32,
            );
        }
        let count = (&visible, splats as u32);
        let (_, order) = sort_first_pairs(client, &depths, &indices, count, 32);
        let mut counted = Self {
            packed,
            opacities,
            frames,
            visible,
            order,
            offsets: Buffer::empty(client, splats + 1),
        };
        let none = [(); 3].map(|()| Buffer::empty(client, 1));
        counted.walk(client, none.each_ref(), 0, false);
        let (offsets, total) = exclusive_sum_with_total(client, &counted.offsets);
        counted.offsets = offsets;
        (counted, total)
    }

    /// Counts the tiles of every splat, or emits keys, slots and splats of the instances.
    fn walk(&self, client: &Client, out: [&Buffer; 3], capacity: usize, emit: bool) {
        let [keys, slots, slot_splats] = out;
        if let Some((count, dim)) = per_element(self.frames.splats() + 1) {
            walk_tiles::launch(
                client,
                count,
                dim,
                self.packed.arg(),
                self.opacities.arg(),
                self.visible.arg(),
                self.order.arg(),
                self.offsets.arg(),
                keys.arg(),
                slots.arg(),
                slot_splats.arg(),
                self.frames.uniforms(),
                capacity as u32,
                emit,
            );
        }
    }

    /// The lists, if there are at most `capacity` instances; `instances` is that capacity.
    fn list(&self, client: &Client, capacity: usize) -> TileLists {
        let tiles = self.frames.tiles();
        let at = self.frames.splats() as u32;
        let out = [(); 3].map(|()| Buffer::empty(client, capacity));
        if capacity > 0 {
            self.walk(client, out.each_ref(), capacity, true);
        }
        let [keys, slots, slot_splats] = out;
        let count = (&self.offsets, at);
        let (keys, slots) = sort_first_pairs(client, &keys, &slots, count, bits_for(tiles + 1));

        let ranges = Buffer::empty(client, tiles * 2);
        if let Some((count, dim)) = per_element(tiles) {
            tile_ranges::launch(
                client,
                count,
                dim,
                keys.arg(),
                self.offsets.arg(),
                ranges.arg(),
                at,
                capacity as u32,
                tiles as u32,
            );
        }
        let tile_splats = Buffer::empty(client, capacity);
        if let Some((count, dim)) = per_element(capacity) {
            gather::launch(
                client,
                count,
                dim,
                slots.arg(),
                slot_splats.arg(),
                self.offsets.arg(),
                tile_splats.arg(),
                at,
                capacity as u32,
            );
        }
        TileLists {
            instances: capacity,
            splats: tile_splats,
            ranges,
            slots: Some(Slots {
                of: slots,
                visible: self.visible.clone(),
                order: self.order.clone(),
                offsets: self.offsets.clone(),
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn instances_are_refused_from_the_first_one_whose_gradients_cannot_be_indexed() {
        for instances in [0, 1, MAX_INSTANCES] {
            let count = check_instances(instances, MAX_INSTANCES);
            assert_eq!(count, Ok(instances as usize));
            assert!(instances * MAX_SLOT_VALUES as u64 <= u64::from(u32::MAX));
        }
        for instances in [MAX_INSTANCES + 1, 1 << 31, 1 << 32, (1 << 32) + 5, u64::MAX] {
            let error = check_instances(instances, MAX_INSTANCES).unwrap_err();
            assert!(error.to_string().contains(&instances.to_string()));
        }
    }
}
