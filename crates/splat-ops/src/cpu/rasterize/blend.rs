//! Blends the splats of a tile, front to back.
//!
//! Block by block, and each block in three passes over the splats that reach it: raw alphas, which depend on nothing
//! else; weights, one splat after the other; colours, a product of matrices. Each is a short loop, of which the processor
//! has several turns under way at once. All in one, it would wait for every exponential.

use super::super::intersect::TILE;
use super::super::real::Real;
use super::batch::{BATCH, Batch, Reached, by_groups};
use super::splat::{Aligned, BLOCKS, LANES, Lanes, Thresholds, centres, corner, in_blocks, least};
use super::work::Tally;
use super::{Slab, View};

/// The pixels of a tile while it is being blended, by block.
pub(super) struct BlendTile<T> {
    transmittance: [Aligned<Lanes<T>>; BLOCKS],
    /// The least raw alpha that still counts: `alpha_min`, infinity once the pixel has stopped or where
    /// there is none.
    gate: [Aligned<Lanes<T>>; BLOCKS],
    /// The place of the splat before which the pixel stopped; `i32::MAX` while it has not.
    stop: [Aligned<Lanes<i32>>; BLOCKS],
    /// D of each block.
    colors: Vec<Aligned<Lanes<T>>>,
    batch: Batch<T>,
    /// Of every splat that reaches the block at hand: raw alphas, then weights.
    weights: [Aligned<Lanes<T>>; BATCH],
}

impl<T: Real> BlendTile<T> {
    pub(super) fn new(channels: usize) -> Self {
        Self {
            transmittance: [Aligned([T::ONE; LANES]); BLOCKS],
            gate: [Aligned([T::of(f64::INFINITY); LANES]); BLOCKS],
            stop: [Aligned([i32::MAX; LANES]); BLOCKS],
            colors: vec![Aligned([T::ZERO; LANES]); channels * BLOCKS],
            batch: Batch::new(),
            weights: [Aligned([T::ZERO; LANES]); BATCH],
        }
    }

    /// Starts a tile anew and blends the splats of its list; adds which blocks each of them reaches.
    #[inline(always)]
    pub(super) fn blend<const FMA: bool>(
        &mut self,
        view: &View<T>,
        list: &[u32],
        tile: [usize; 2],
        channels: usize,
        reached: &mut Reached,
        tally: &mut impl Tally,
    ) {
        let thresholds = Thresholds::<T>::new(view.args);
        let corner = corner(tile);
        let mut open = self.begin(view.inside(tile), &thresholds);
        let end = reached.len() + list.len();

        for (number, part) in list.chunks(BATCH).enumerate() {
            let splats = self.batch.gather(view, part);
            let first = reached.len();
            reached.resize(first + splats.len(), 0);
            for (blocks, splat) in reached[first..].iter_mut().zip(splats) {
                *blocks = splat.blocks(corner) & open;
            }
            self.batch.places.fill(&reached[first..]);
            for block in 0..BLOCKS {
                if open >> block & 1 == 0 {
                    continue;
                }
                self.evaluate::<FMA>(block, corner, &thresholds, tally);
                let place = (number * BATCH) as i32;
                let (count, is_open) = self.weigh::<FMA>(block, place, &thresholds, tally);
                by_groups!(self.add_colors::<FMA>(channels, view, part, block, count));
                if !is_open {
                    open &= !(1 << block);
                }
            }
            if open == 0 {
                break;
            }
        }
        reached.resize(end, 0);
    }

    /// Clears the tile; returns which blocks have pixels, a bit for each.
    #[inline(always)]
    fn begin(&mut self, [columns, rows]: [usize; 2], thresholds: &Thresholds<T>) -> u16 {
        self.transmittance = [Aligned([T::ONE; LANES]); BLOCKS];
        self.gate = [Aligned([T::of(f64::INFINITY); LANES]); BLOCKS];
        self.stop = [Aligned([i32::MAX; LANES]); BLOCKS];
        self.colors.fill(Aligned([T::ZERO; LANES]));
        let mut open = 0;
        for row in 0..rows {
            for column in 0..columns {
                let [block, lane] = in_blocks(column, row);
                self.gate[block].0[lane] = thresholds.alpha_min;
                open |= 1 << block;
            }
        }
        open
    }

    /// Raw alphas of the splats that reach a block.
    #[inline(always)]
    fn evaluate<const FMA: bool>(
        &mut self,
        block: usize,
        corner: [T; 2],
        thresholds: &Thresholds<T>,
        tally: &mut impl Tally,
    ) {
        let [xs, ys] = centres(corner, block);
        for (weights, splat) in self.weights.iter_mut().zip(self.batch.reaching(block)) {
            let mut raw = [T::ZERO; LANES];
            for i in 0..LANES {
                (_, _, raw[i]) = splat.at::<FMA>(xs[i], ys[i]);
                tally.tested(thresholds.seen(raw[i]));
            }
            *weights = Aligned(raw);
        }
    }

    /// Turns raw alphas into weights, the share of a pixel's light that each splat sends. The list's batch begins at a
    /// `place`. Returns how many splats there are until all pixels of the block have stopped, and whether any has not.
    #[inline(always)]
    fn weigh<const FMA: bool>(
        &mut self,
        block: usize,
        place: i32,
        thresholds: &Thresholds<T>,
        tally: &mut impl Tally,
    ) -> (usize, bool) {
        let closed = T::of(f64::INFINITY);
        let (transmittance, gates) = (&mut self.transmittance[block], &mut self.gate[block]);
        let places = self.batch.places.of(block);
        for (number, (weights, in_batch)) in self.weights.iter_mut().zip(places).enumerate() {
            // Copies: behind references they might alias what is written, which bars SIMD.
            let (Aligned(raw), Aligned(before), Aligned(gate)) = (*weights, *transmittance, *gates);
            let [mut shares, mut left] = [[T::ZERO; LANES]; 2];
            for i in 0..LANES {
                // Every store is unconditional: masked ones are slow. Without a share nothing changes, exactly.
                let alpha = thresholds.alpha(raw[i]);
                shares[i] = if raw[i] >= gate[i] { alpha } else { T::ZERO };
                left[i] = T::multiply_add::<FMA>(-shares[i], before[i], before[i]);
                tally.blended(raw[i] >= gate[i] && !thresholds.stops(left[i]));
            }
            // Once in a pixel's life; for all lanes without a branch.
            if thresholds.stops(least(&left)) {
                let (mut gate, mut stop) = (gate, self.stop[block].0);
                let place = place + i32::from(*in_batch);
                for i in 0..LANES {
                    let stops = thresholds.stops(left[i]);
                    left[i] = if stops { before[i] } else { left[i] };
                    shares[i] = if stops { T::ZERO } else { shares[i] };
                    gate[i] = if stops { closed } else { gate[i] };
                    stop[i] = if stops { place } else { stop[i] };
                }
                (gates.0, self.stop[block].0) = (gate, stop);
                if least(&gate) == closed {
                    return (number, false);
                }
            }
            transmittance.0 = left;
            for i in 0..LANES {
                weights.0[i] = shares[i] * before[i];
            }
        }
        (places.len(), true)
    }

    /// Adds the colours of the first splats that reach a block, times their weights.
    #[inline(always)]
    fn add_colors<const FMA: bool, const GROUP: usize>(
        &mut self,
        first: usize,
        view: &View<T>,
        list: &[u32],
        block: usize,
        count: usize,
    ) {
        let planes = &mut self.colors[block * view.channels + first..][..GROUP];
        let mut sums: [Lanes<T>; GROUP] = core::array::from_fn(|i| planes[i].0);
        let places = self.batch.places.of(block);
        for (weights, place) in self.weights[..count].iter().zip(places) {
            let colors = view.colors::<GROUP>(list[usize::from(*place)], first);
            for (sum, color) in sums.iter_mut().zip(colors) {
                for i in 0..LANES {
                    sum[i] = T::multiply_add::<FMA>(color, weights.0[i], sum[i]);
                }
            }
        }
        for (plane, sum) in planes.iter_mut().zip(sums) {
            plane.0 = sum;
        }
    }

    /// Writes the tile into its row of tiles, with the background behind it.
    #[inline(always)]
    pub(super) fn store(&self, view: &View<T>, [tx, ty]: [usize; 2], slab: &mut Slab<T>) {
        // With a number of channels that the compiler knows, their loops are unrolled.
        match view.channels {
            3 => self.store_channels(view, [tx, ty], slab, 3),
            channels => self.store_channels(view, [tx, ty], slab, channels),
        }
    }

    #[inline(always)]
    fn store_channels(
        &self,
        view: &View<T>,
        [tx, ty]: [usize; 2],
        slab: &mut Slab<T>,
        channels: usize,
    ) {
        let [columns, rows] = view.inside([tx, ty]);
        for row in 0..rows {
            for column in 0..columns {
                let [block, lane] = in_blocks(column, row);
                let pixel = row * view.width + tx * TILE + column;
                let left = self.transmittance[block].0[lane];
                let out = &mut slab.image[pixel * (channels + 1)..(pixel + 1) * (channels + 1)];
                for channel in 0..channels {
                    let behind = view.background.map_or(T::ZERO, |b| b[channel]);
                    out[channel] = self.colors[block * channels + channel].0[lane] + left * behind;
                }
                out[channels] = T::ONE - left;
                slab.transmittance[pixel] = left;
                slab.stop[pixel] = self.stop[block].0[lane];
            }
        }
    }
}
