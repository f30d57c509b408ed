//! The blocks of pixels that were worked on.

use super::super::intersect::TILE;
use super::super::real::Real;
use super::splat::{Centres, LANES, Splat, Window};

/// Two in each row of a tile at most; a power of two, and more than are ever used, so that indices need no check.
const MAX_BLOCKS: usize = 64;

/// Blocks that a pair usually has: what memory is reserved for at first.
const USUAL_BLOCKS: usize = 12;

/// The blocks of every splat in every tile of a row of tiles: made by the forward pass, walked back by the backward.
#[derive(Debug, Default)]
pub(super) struct Blocks {
    /// First pixels, counted through the tile row by row. Longer than what is used.
    starts: Vec<u8>,
    /// How many of them each (tile, splat) pair has.
    counts: Vec<u8>,
    end: usize,
}

impl Blocks {
    /// For so many (tile, splat) pairs.
    pub(super) fn new(pairs: usize) -> Self {
        Self {
            starts: Vec::with_capacity(USUAL_BLOCKS * pairs + MAX_BLOCKS),
            counts: Vec::with_capacity(pairs),
            end: 0,
        }
    }

    /// Adds the blocks that cover what a splat reaches in a tile, as far as it lies within a window, and returns them.
    #[inline(always)]
    pub(super) fn cover<T: Real>(
        &mut self,
        splat: &Splat<T>,
        tile: &Centres<T>,
        within: &Window,
    ) -> &[u8] {
        if self.starts.len() < self.end + MAX_BLOCKS {
            self.starts.resize(2 * self.end + 16 * MAX_BLOCKS, 0);
        }
        let starts = &mut self.starts[self.end..];
        let mut count = 0;
        if let Some(starts) = starts.first_chunk_mut::<MAX_BLOCKS>() {
            let reached = splat.spans(tile);
            for row in splat.rows(tile) {
                let from = reached.from[row].max(within.from[row]);
                let to = reached.to[row].min(within.to[row]);
                count = cover_row(starts, count, row, from, to);
            }
        }
        self.counts.push(count as u8);
        self.end += count;
        &starts[..count]
    }

    /// Says of so many pairs that they have no blocks.
    pub(super) fn skip(&mut self, pairs: usize) {
        self.counts.extend(core::iter::repeat_n(0, pairs));
    }

    /// How many blocks some pairs have.
    pub(super) fn count(&self, pairs: core::ops::Range<usize>) -> usize {
        self.counts[pairs]
            .iter()
            .map(|count| usize::from(*count))
            .sum()
    }

    /// The blocks of a pair that end before the given one, which moves to where they begin.
    #[inline(always)]
    pub(super) fn before(&self, end: &mut usize, pair: usize) -> &[u8] {
        let last = *end;
        *end = last.saturating_sub(usize::from(self.counts[pair]));
        &self.starts[*end..last]
    }
}

/// Adds what covers columns `from` up to `to` of a row: nothing, one block wherever it fits best, or both halves.
// Without branches, which would depend on the splat and be guessed wrongly as often as not.
#[inline(always)]
fn cover_row(
    starts: &mut [u8; MAX_BLOCKS],
    mut count: usize,
    row: usize,
    from: i32,
    to: i32,
) -> usize {
    let last = TILE - LANES;
    let whole = to - from > LANES as i32;
    let first = if whole { 0 } else { (from as usize).min(last) };
    starts[count % MAX_BLOCKS] = (row * TILE + first) as u8;
    count += usize::from(to > from);
    starts[count % MAX_BLOCKS] = (row * TILE + last) as u8;
    count + usize::from(whole)
}
