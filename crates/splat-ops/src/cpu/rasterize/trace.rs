//! State of each row of tiles that the forward pass keeps for the backward pass.

use core::ops::Range;

use super::super::tiles::TILE;
use super::splat::{Aligned, BATCH, BLOCKS, Lanes};

/// One value per pixel of a tile, by block.
pub(super) type ByBlock<T> = [Aligned<Lanes<T>>; BLOCKS];

/// Bytes that are kept of each intersection, at most, with numbers of this size.
pub(super) const fn kept_per_intersection(number: usize) -> usize {
    size_of::<u16>() + number * (TILE * TILE).div_ceil(BATCH)
}

/// State of the tiles of a row, one after the other.
pub(super) struct Trace<T> {
    /// The blocks that every splat of each tile's list reaches, a bit per block; none from the
    /// batch on that found every pixel stopped.
    pub(super) reached: Vec<u16>,
    /// The place in the list of the splat before which each pixel stopped; `i32::MAX` where it did
    /// not.
    pub(super) stop: Vec<ByBlock<i32>>,
    /// Transmittance in front of every batch of a list but the first, as far as there is any, and,
    /// if there is a background, behind the last splat. One minus alpha would lose its digits.
    pub(super) transmittance: Vec<ByBlock<T>>,
    /// Where each tile's end among these.
    ends: Vec<usize>,
}

/// The same of one tile.
pub(super) struct TileTrace<'a, T> {
    pub(super) reached: &'a [u16],
    pub(super) stop: &'a ByBlock<i32>,
    pub(super) transmittance: &'a [ByBlock<T>],
}

impl<T> Trace<T> {
    /// Room for this many tiles, with this many splats in their lists together.
    pub(super) fn with_capacity(tiles: usize, splats: usize) -> Self {
        Self {
            reached: Vec::with_capacity(splats),
            stop: Vec::with_capacity(tiles),
            transmittance: Vec::new(),
            ends: Vec::with_capacity(tiles),
        }
    }

    /// Ends a tile.
    pub(super) fn end_tile(&mut self, stop: &ByBlock<i32>) {
        self.stop.push(*stop);
        self.ends.push(self.transmittance.len());
    }

    /// A tile, whose list has these places among all of the row.
    pub(super) fn tile(&self, tile: usize, list: Range<usize>) -> TileTrace<'_, T> {
        let first = tile.checked_sub(1).map_or(0, |before| self.ends[before]);
        TileTrace {
            reached: &self.reached[list],
            stop: &self.stop[tile],
            transmittance: &self.transmittance[first..self.ends[tile]],
        }
    }
}
