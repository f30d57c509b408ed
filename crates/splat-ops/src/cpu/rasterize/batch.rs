//! Splats of a tile's list that are worked on together, and which of them reach each block of the tile.

use super::super::real::Real;
use super::super::simd::prefetch;
use super::View;
use super::splat::{AHEAD, BLOCKS, Splat};

/// How many: so many that what is kept of each fits the first-level cache, and few enough for eight bits.
pub(super) const BATCH: usize = 128;

/// The blocks that every splat reaches in every tile of a row of tiles: found by the forward pass, used again by the
/// backward. A bit per block, a number per (tile, splat) pair; none from the batch on that found every pixel stopped.
pub(super) type Reached = Vec<u16>;

/// Calls a method for all channels, a few at a time and of a number that the compiler knows, which unrolls its loops:
/// `method::<FMA, GROUP>(first, ...)`.
macro_rules! by_groups {
    ($this:ident.$method:ident::<$fma:ident>($channels:ident $(, $argument:expr)*)) => {{
        let mut first = 0;
        while first < $channels {
            let group = 4.min($channels - first);
            match group {
                1 => $this.$method::<$fma, 1>(first $(, $argument)*),
                2 => $this.$method::<$fma, 2>(first $(, $argument)*),
                3 => $this.$method::<$fma, 3>(first $(, $argument)*),
                _ => $this.$method::<$fma, 4>(first $(, $argument)*),
            }
            first += group;
        }
    }};
}

pub(super) use by_groups;

/// The splats, side by side.
pub(super) struct Batch<T> {
    splats: Vec<Splat<T>>,
    pub(super) places: Places,
}

impl<T: Real> Batch<T> {
    pub(super) fn new() -> Self {
        Self {
            splats: vec![Splat::default(); BATCH],
            places: Places::new(),
        }
    }

    /// Fetches the splats of a part of a list, and returns them.
    #[inline(always)]
    pub(super) fn gather(&mut self, view: &View<T>, list: &[u32]) -> &[Splat<T>] {
        for (place, (splat, index)) in self.splats.iter_mut().zip(list).enumerate() {
            let next = list.get(place + AHEAD).map(|index| *index as usize);
            prefetch(view.splats, next);
            prefetch(view.colors, next.map(|index| index * view.channels));
            *splat = view.splats[*index as usize];
        }
        &self.splats[..list.len()]
    }

    /// Those that reach a block, in order.
    #[inline(always)]
    pub(super) fn reaching(&self, block: usize) -> impl Iterator<Item = Splat<T>> {
        let splats = &self.splats;
        let places = self.places.of(block).iter();
        places.map(|place| splats[usize::from(*place)])
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

    pub(super) fn of(&self, block: usize) -> &[u8] {
        &self.places[block][..self.counts[block]]
    }

    /// From the blocks of each splat of a batch, of which there are [`BATCH`] at most.
    // Eight splats at a time and without branches, which would depend on the splats and be guessed wrongly as often as not.
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

/// An 8 x 8 matrix of bits, turned: bit j of byte i becomes bit i of byte j. By halves: blocks of one, two and four bits
/// change places (Warren, Hacker's Delight, 7-3).
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

/// Of every byte the bits that are set, and how many they are.
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
