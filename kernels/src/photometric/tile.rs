//! The tile of a workgroup, and the runs of values that its units window.

use cubecl::prelude::*;

use super::{Sizes, TargetKind};
use crate::ssim::{RUN, UNROLLED_TAPS, windowed};

/// Width of a tile in pixels.
pub(super) const TILE_WIDTH: usize = 32;
pub(super) const TILE_HEIGHT: usize = 16;
/// Floats between rows in shared memory: one more than needed, so that the runs of different rows
/// are in different banks.
pub(super) const PITCH: usize = TILE_WIDTH + 1;
/// Runs along a row of a tile.
pub(super) const RUNS: usize = TILE_WIDTH / RUN;
/// Units of a workgroup; each makes a run down a column.
pub(super) const UNITS: usize = TILE_WIDTH * TILE_HEIGHT / RUN;
/// mx, my, q, p.
pub(super) const MOMENTS: usize = 4;
/// Derivatives by mx, q, p.
pub(super) const FIELDS: usize = 3;

/// The tile and channel of a workgroup.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Place {
    /// False for excess workgroups.
    pub exists: bool,
    pub image: u32,
    pub channel: u32,
    /// First pixel.
    pub x: u32,
    pub y: u32,
}

#[cube]
impl Place {
    /// Channels of a tile are adjacent, so that they find its pixels in the cache.
    pub fn new(sizes: Sizes) -> Place {
        let cube = CUBE_POS as u32;
        let tile = cube / sizes.channels;
        let row = tile / sizes.columns;
        let image = row / sizes.rows;
        Place {
            exists: image < sizes.images,
            image,
            channel: cube % sizes.channels,
            x: tile % sizes.columns * TILE_WIDTH as u32,
            y: row % sizes.rows * TILE_HEIGHT as u32,
        }
    }

    /// True if a pixel is in the image, with its index over all images (of another pixel if not).
    /// Its position may be shifted left and up by `back`, beyond the edge.
    pub fn pixel(self, sizes: Sizes, x: u32, y: u32, back: u32) -> (bool, usize) {
        let inside = self.exists
            && x >= back
            && y >= back
            && x - back < sizes.width
            && y - back < sizes.height;
        let index = (self.image * sizes.height + y - back) * sizes.width + x - back;
        (inside, select(inside, index, 0u32) as usize)
    }
}

/// Value number `index` of the photo.
#[cube]
pub(super) fn target_value(target: &[u32], index: usize, #[comptime] kind: TargetKind) -> f32 {
    if comptime!(kind == TargetKind::Values) {
        f32::reinterpret(target[index])
    } else if comptime!(kind == TargetKind::Words) {
        i32::reinterpret(target[index]) as f32 / 255.0f32
    } else {
        let shift = (index % 4) as u32 * 8u32;
        ((target[index / 4] >> shift) & 0xffu32) as f32 / 255.0f32
    }
}

/// Stores a run along row `row` of a field in shared memory.
#[cube]
pub(super) fn put(
    shared: &mut Shared<[f32]>,
    sums: &Array<f32>,
    field: usize,
    row: usize,
    run: usize,
    #[comptime] taps: usize,
) {
    let to = (field * comptime!(TILE_HEIGHT + taps - 1) + row) * PITCH + run * RUN;
    #[unroll]
    for o in 0..RUN {
        shared[to + o] = sums[o];
    }
}

/// The unit's run, windowed down its column of a field.
#[cube]
pub(super) fn down_column(
    shared: &Shared<[f32]>,
    field: usize,
    window: &Array<f32>,
    sums: &mut Array<f32>,
    #[comptime] taps: usize,
) {
    let unrolled = comptime!(taps <= UNROLLED_TAPS);
    let span = comptime!(RUN + taps - 1);
    let first = UNIT_POS as usize / TILE_WIDTH * RUN;
    let from = (field * comptime!(TILE_HEIGHT + taps - 1) + first) * PITCH
        + UNIT_POS as usize % TILE_WIDTH;
    let mut values = Array::<f32>::new(span);
    #[unroll(unrolled)]
    for i in 0..span {
        values[i] = shared[from + i * PITCH];
    }
    windowed(&values, window, sums, taps, unrolled);
}
