//! The tiles of an image.

use splat_core::TILE_SIDE;

use crate::settings::RasterizeArgs;

/// Side of a tile in pixels.
pub(super) const TILE: usize = TILE_SIDE;

/// Splats per unit of parallel work.
pub(super) const CHUNK: usize = 256;

/// Tiles of an image.
#[derive(Clone, Copy)]
pub(super) struct Grid {
    pub(super) columns: usize,
    pub(super) rows: usize,
}

impl Grid {
    pub(super) fn new(args: &RasterizeArgs) -> Self {
        Self {
            columns: (args.size.width as usize).div_ceil(TILE),
            rows: (args.size.height as usize).div_ceil(TILE),
        }
    }

    pub(super) fn tiles(self) -> usize {
        self.columns * self.rows
    }
}
