//! Splats of a tile's list that are worked on together, and which of them reach each block of the
//! tile.

use core::ops::Range;

use super::super::real::Real;
use super::super::simd::prefetch;
use super::splat::{BATCH, BLOCKS, GROUP, Splat};
use super::view::View;

/// Calls a method for some channels, a few at a time and of a number that the compiler knows, which
/// unrolls its loops: `method::<S, COUNT>(first, ...)`.
macro_rules! by_groups {
    ($this:ident.$method:ident$(::<$simd:ident>)?($first:tt..$end:ident $(, $argument:expr)*)) => {{
        let mut first = $first;
        while first < $end {
            let count = GROUP.min($end - first);
            match count {
                1 => $this.$method::<$($simd,)? 1>(first $(, $argument)*),
                2 => $this.$method::<$($simd,)? 2>(first $(, $argument)*),
                3 => $this.$method::<$($simd,)? 3>(first $(, $argument)*),
                _ => $this.$method::<$($simd,)? GROUP>(first $(, $argument)*),
            }
            first += count;
        }
    }};
}

pub(super) use by_groups;

/// As many as there are places of eight bits, so that no place needs a check.
pub(super) type ByPlace<V> = [V; 1 << u8::BITS];

/// The splats, side by side.
pub(super) struct Batch<T> {
    splats: Box<ByPlace<Splat<T>>>,
    /// By group of channels, from the second one on.
    further_colors: Vec<ByPlace<[T; GROUP]>>,
    pub(super) places: Places,
}

impl<T: Real> Batch<T> {
    pub(super) fn new(channels: usize) -> Self {
        let further = channels.saturating_sub(GROUP).div_ceil(GROUP);
        Self {
            splats: Box::new([Splat::default(); _]),
            further_colors: vec![[[T::ZERO; GROUP]; _]; further],
            places: Places::new(),
        }
    }

    /// Fetches the splats of a part of a list with their colours, and returns them; and begins to
    /// fetch those of the part that comes next, which lie anywhere in memory.
    #[inline(always)]
    pub(super) fn gather(&mut self, view: &View<T>, list: &[u32], next: &[u32]) -> &[Splat<T>] {
        for (splat, index) in self.splats.iter_mut().zip(list) {
            *splat = view.splats[*index as usize];
        }
        for index in next {
            prefetch(view.splats, *index as usize..*index as usize + 1);
        }
        let channels = view.channels;
        by_groups!(self.gather_colors(GROUP..channels, view, list));
        &self.splats[..list.len()]
    }

    /// Some of the channels that a splat does not have with it.
    #[inline(always)]
    fn gather_colors<const COUNT: usize>(&mut self, first: usize, view: &View<T>, list: &[u32]) {
        let width = view.channels - GROUP;
        let colors = &mut self.further_colors[first / GROUP - 1];
        for (batched, index) in colors.iter_mut().zip(list) {
            let at = *index as usize * width + first - GROUP;
            let colors = &view.further_colors[at..at + COUNT];
            batched[..COUNT].copy_from_slice(colors);
        }
    }

    /// Some of those that reach a block, in order.
    // Copies: behind references they might alias what is written, which bars SIMD.
    #[inline(always)]
    pub(super) fn reaching(
        &self,
        block: usize,
        range: Range<usize>,
    ) -> impl DoubleEndedIterator<Item = Splat<T>> + ExactSizeIterator {
        let places = self.places.of(block)[range].iter();
        places.map(|place| self.splat(*place))
    }

    #[inline(always)]
    pub(super) fn splat(&self, place: u8) -> Splat<T> {
        self.splats[usize::from(place)]
    }

    /// Some channels of their colours that they do not have with them, from a first one on.
    #[inline(always)]
    pub(super) fn colors(&self, block: usize, first: usize) -> impl Iterator<Item = [T; GROUP]> {
        let places = self.places.of(block).iter();
        let colors = &self.further_colors[first / GROUP - 1];
        places.map(|place| colors[usize::from(*place)])
    }
}

/// For each block of a tile, the places in the batch of the splats that reach it, in order.
pub(super) struct Places {
    /// Eight at a time are written, so beyond the last.
    places: [[u8; BATCH + 8]; BLOCKS],
    counts: [usize; BLOCKS],
}

impl Places {
    pub(super) fn new() -> Self {
        Self {
            places: [[0; BATCH + 8]; BLOCKS],
            counts: [0; BLOCKS],
        }
    }

    #[inline(always)]
    pub(super) fn of(&self, block: usize) -> &[u8] {
        &self.places[block][..self.counts[block]]
    }

    /// From the blocks of each splat of a batch, of which there are [`BATCH`] at most.
    // Eight splats at a time and without branches, which would depend on the splats and be guessed
    // wrongly as often as not.
    #[inline(always)]
    pub(super) fn fill(&mut self, reached: &[u16]) {
        self.counts = [0; BLOCKS];
        for (group, splats) in reached[..reached.len().min(BATCH)].chunks(8).enumerate() {
            let (mut low, mut high) = ([0; 8], [0; 8]);
            for (i, blocks) in splats.iter().enumerate() {
                [low[i], high[i]] = blocks.to_le_bytes();
            }
            let (low, high) = (transposed(low), transposed(high));
            let first = [8 * group as u8; 8];
            for block in 0..BLOCKS {
                let splats = if block < 8 {
                    low[block]
                } else {
                    high[block - 8]
                };
                let (set, count) = BITS[usize::from(splats)];
                let at = self.counts[block].min(BATCH);
                let places = &mut self.places[block][at..at + 8];
                for i in 0..8 {
                    places[i] = set[i].wrapping_add(first[i]);
                }
                self.counts[block] = at + usize::from(count);
            }
        }
    }
}

/// An 8 x 8 matrix of bits, turned: bit j of byte i becomes bit i of byte j. By halves: blocks of
/// one, two and four bits change places (Warren, Hacker's Delight, 7-3).
#[inline(always)]
fn transposed(rows: [u8; 8]) -> [u8; 8] {
    let mut bits = u64::from_le_bytes(rows);
    for (shift, mask) in [
        (7, 0x00AA_00AA_00AA_00AA),
        (14, 0x0000_CCCC_0000_CCCC),
        (28, 0x0000_0000_F0F0_F0F0),
    ] {
        let change = (bits ^ (bits >> shift)) & mask;
        bits ^= change ^ (change << shift);
    }
    bits.to_le_bytes()
}

/// The set bits of every byte, and how many they are.
static BITS: [([u8; 8], u8); 256] = {
    let mut table = [([0; 8], 0); 256];
    let mut byte = 0;
    while byte < 256 {
        let mut bit = 0;
        while bit < 8 {
            if byte >> bit & 1 == 1 {
                let (set, count) = &mut table[byte];
                set[*count as usize] = bit;
                *count += 1;
            }
            bit += 1;
        }
        byte += 1;
    }
    table
};

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};

    #[test]
    fn every_block_lists_the_splats_that_reach_it_in_order() {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(5);
        let mut places = Places::new();
        for count in [0, 1, 7, 8, 9, 100, BATCH] {
            for full in [false, true] {
                let blocks = (0..count).map(|_| if full { u16::MAX } else { rng.random() });
                let reached: Vec<u16> = blocks.collect();
                places.fill(&reached);
                for block in 0..BLOCKS {
                    let expected = (0..count).filter(|i| reached[*i] >> block & 1 == 1);
                    let expected: Vec<u8> = expected.map(|i| i as u8).collect();
                    assert_eq!(places.of(block), expected, "{count} splats, block {block}");
                }
            }
        }
    }
}
