//! How a workgroup shares out its tile, and the batches of splats that it reads together.
//!
//! The tile's pixels are cut into square *blocks*. The units that own a block walk only those
//! splats of the batch whose ellipse meets the block, found by the same test that listed the splats
//! of the tile. Every batch has one bit per (block, splat); a block's bits are its list.

use cubecl::client::Client;
use cubecl::prelude::*;
use splat_core::PROJECTED_WIDTH;

use super::MAX_CHANNELS;
use super::pair::SHAPE;
use crate::intersect::{Footprint, Grid, TILE};
use crate::planes::plane_size;

/// Splats of a batch.
pub(super) const BATCH: usize = 64;
/// Words of bits for a batch.
pub(super) const WORDS: usize = BATCH / 32;

/// How the pixels of a tile are dealt to the units of its workgroup.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct Plan {
    /// Units of a block. One: the block's gradients are summed where they arise, and no two units
    /// ever wait for each other within a batch. A plane: they are summed by plane operations, and
    /// all units of a plane take the same way.
    lanes: usize,
}

impl Plan {
    /// Blocks of 8 x 8 pixels to planes; of 4 x 4 to single units where there are no planes.
    pub fn new(client: &Client) -> Self {
        Self {
            lanes: plane_size(client).unwrap_or(1),
        }
    }

    #[cfg(test)]
    pub fn with_lanes(lanes: usize) -> Self {
        Self { lanes }
    }

    pub fn lanes(self) -> usize {
        self.lanes
    }

    /// Most channels of one launch. A unit keeps their values for all of its pixels, at most 128
    /// floats, in registers. Without planes it is 256: on a software device, where memory is as
    /// near, 16 channels at once took a fifth less time than 8 and 8.
    pub fn channels(self) -> usize {
        let floats = if self.lanes == 1 { 256 } else { 128 };
        (floats / self.pixels()).min(MAX_CHANNELS)
    }

    /// Pixels along a side of a block.
    pub fn side(self) -> usize {
        if self.lanes == 1 { 4 } else { 8 }
    }

    /// Pixels of one unit.
    pub fn pixels(self) -> usize {
        self.side() * self.side() / self.lanes
    }

    /// Blocks along a side of a tile.
    pub fn columns(self) -> usize {
        TILE as usize / self.side()
    }

    /// Blocks of a tile.
    pub fn blocks(self) -> usize {
        self.columns() * self.columns()
    }

    /// Units of a workgroup.
    pub fn units(self) -> usize {
        self.blocks() * self.lanes
    }

    pub fn cube_dim(self) -> CubeDim {
        CubeDim::new_1d(self.units() as u32)
    }
}

/// Where a unit is.
#[derive(CubeType, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(super) struct Place {
    /// Over all cameras.
    pub tile: u32,
    pub camera: u32,
    /// The tile's first pixel.
    pub tile_x: u32,
    pub tile_y: u32,
    /// The unit's block of the tile.
    pub block: u32,
    /// Which of the block's units it is.
    pub lane: u32,
}

#[cube]
pub(super) fn place(grid: Grid, #[comptime] plan: Plan) -> Place {
    let lanes = comptime!(plan.lanes() as u32);
    let tile = CUBE_POS as u32;
    let in_image = tile % (grid.columns * grid.rows);
    Place {
        tile,
        camera: tile / (grid.columns * grid.rows),
        tile_x: in_image % grid.columns * TILE,
        tile_y: in_image / grid.columns * TILE,
        block: UNIT_POS / lanes,
        lane: UNIT_POS % lanes,
    }
}

/// First pixel of a block, in the image.
#[cube]
fn corner(place: Place, block: u32, #[comptime] plan: Plan) -> (u32, u32) {
    let columns = comptime!(plan.columns() as u32);
    let side = comptime!(plan.side() as u32);
    (
        place.tile_x + block % columns * side,
        place.tile_y + block / columns * side,
    )
}

#[cube]
impl Place {
    /// The unit's q-th pixel, in the image. With many units to a block all pixels of a unit have
    /// one x.
    pub fn pixel(self, q: usize, #[comptime] plan: Plan) -> (u32, u32) {
        let (x, y) = corner(self, self.block, plan);
        let side = comptime!(plan.side() as u32);
        let rows = comptime!((plan.lanes() / plan.side()) as u32);
        let q = q as u32;
        if comptime!(plan.lanes() == 1) {
            (x + q % side, y + q / side)
        } else {
            (x + self.lane % side, y + self.lane / side + q * rows)
        }
    }
}

/// Whether a pixel is in the image, and its index over all cameras; that of some other pixel if
/// not.
#[cube]
pub(super) fn pixel_index(grid: Grid, place: Place, x: u32, y: u32) -> (bool, usize) {
    let inside = place.tile < grid.tiles && x < grid.width && y < grid.height;
    let index = (place.camera * grid.height + y) * grid.width + x;
    (inside, select(inside, index, 0u32) as usize)
}

/// The splats of a batch in shared memory.
#[derive(CubeType)]
pub(super) struct Batch {
    /// [`SHAPE`] floats and then the colours of each.
    pub splats: Shared<[f32]>,
    /// Bit b of splat k: block b walks it.
    pub touched: Shared<[u32]>,
    /// Bit k of block b: it walks splat k.
    pub walks: Shared<[Atomic<u32>]>,
}

#[cube]
impl Batch {
    pub fn new(#[comptime] plan: Plan, #[comptime] width: usize) -> Batch {
        Batch {
            splats: Shared::new_slice(comptime!(BATCH * (SHAPE + width))),
            touched: Shared::new_slice(BATCH),
            walks: Shared::<[Atomic<u32>]>::new_slice(comptime!(plan.blocks() * WORDS)),
        }
    }

    /// Forgets all bits. Between this and [`Batch::load`] the units must wait for each other.
    pub fn clear(&mut self, #[comptime] plan: Plan) {
        let mut word = UNIT_POS as usize;
        while word < comptime!(plan.blocks() * WORDS) {
            Atomic::store(&self.walks[word], 0u32);
            word += comptime!(plan.units());
        }
    }

    /// Reads `splat` to place `k`; its bits are set for the blocks it meets, of those for which
    /// `entry` is less than `ends[block]`.
    pub fn load(
        &mut self,
        packed: &[f32],
        colors: &[f32],
        opacities: &[f32],
        splat: usize,
        first_color: usize,
        k: usize,
        entry: u32,
        ends: &[Atomic<u32>],
        grid: Grid,
        place: Place,
        #[comptime] plan: Plan,
        #[comptime] width: usize,
    ) {
        let from = splat * PROJECTED_WIDTH;
        let mean_x = packed[from];
        let mean_y = packed[from + 1];
        let w11 = packed[from + 3];
        let w21 = packed[from + 4];
        let w22 = packed[from + 5];
        let opacity = opacities[splat];
        let to = k * comptime!(SHAPE + width);
        self.splats[to] = mean_x;
        self.splats[to + 1] = mean_y;
        self.splats[to + 2] = w11;
        self.splats[to + 3] = w21;
        self.splats[to + 4] = w22;
        self.splats[to + 5] = opacity;
        #[unroll]
        for channel in 0..width {
            self.splats[to + SHAPE + channel] = colors[first_color + channel];
        }

        let footprint = Footprint::new(mean_x, mean_y, w11, w21, w22, opacity, grid.alpha_min);
        let side = comptime!(plan.side() as u32);
        let mut touched = 0u32;
        for block in 0..comptime!(plan.blocks() as u32) {
            let (x, y) = corner(place, block, plan);
            let last_x = min(x + side, grid.width);
            let last_y = min(y + side, grid.height);
            let walked = entry < Atomic::load(&ends[block as usize]);
            if walked && x < grid.width && y < grid.height {
                if footprint.touches(x, last_x, y, last_y) {
                    touched |= 1u32 << block;
                    let word = block as usize * WORDS + k / 32;
                    Atomic::fetch_or(&self.walks[word], 1u32 << (k as u32 % 32u32));
                }
            }
        }
        self.touched[k] = touched;
    }

    /// The bits of `block` for 32 splats.
    pub fn bits(&self, block: u32, word: usize) -> u32 {
        Atomic::load(&self.walks[block as usize * WORDS + word])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_plan_deals_out_every_pixel_of_a_tile_once() {
        for lanes in [1, 8, 16, 32, 64] {
            let plan = Plan::with_lanes(lanes);
            assert_eq!(plan.units() * plan.pixels(), (TILE * TILE) as usize);
            assert!(plan.blocks() <= 32, "a block is a bit");
            assert!(plan.units() <= 256, "every device has that many units");
        }
    }
}
