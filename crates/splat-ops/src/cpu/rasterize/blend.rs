//! Blends the splats of a tile, front to back.
//!
//! Block by block, and each block in three passes over the splats that reach it: raw alphas, which depend on nothing
//! else; weights, one splat after the other; colours, a product of matrices. Each is a short loop, of which the processor
//! has several turns under way at once. All in one, it would wait for every exponential.

use core::ops::Range;

use super::super::intersect::TILE;
use super::super::real::Real;
use super::batch::{BATCH, Batch, Reached, by_groups};
use super::splat::{
    Aligned, BLOCKS, LANES, Lanes, Thresholds, any, centres, corner, in_blocks, square,
};
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
        reached: &mut Reached,
        tally: &mut impl Tally,
    ) {
        let thresholds = Thresholds::<T>::new(view.args);
        let (corner, channels) = (corner(tile), view.channels);
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
            for i in 0..LANES {
                weights.0[i] = square::<T, FMA>(splat.z::<FMA>(xs[i], ys[i]));
            }
        }
        // By itself, so that all that an exponential needs stays in registers.
        for (weights, splat) in self.weights.iter_mut().zip(self.batch.reaching(block)) {
            for i in 0..LANES {
                weights.0[i] = splat.raw::<FMA>(weights.0[i]);
                tally.tested(thresholds.seen(weights.0[i]));
            }
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
        let count = self.batch.places.of(block).len();
        let mut done = 0;
        loop {
            done += self.weigh_until_stop::<FMA>(block, done..count, thresholds, tally);
            if done == count {
                return (count, true);
            }
            let place = place + i32::from(self.batch.places.of(block)[done]);
            if !self.stop_pixels::<FMA>(block, done, place, thresholds) {
                return (done, false);
            }
        }
    }

    /// As far as no pixel stops; returns how many splats that are.
    // Stopping is done elsewhere, once in a pixel's life, so that nothing here depends on it: the transmittance stays in
    // registers.
    #[inline(always)]
    fn weigh_until_stop<const FMA: bool>(
        &mut self,
        block: usize,
        splats: Range<usize>,
        thresholds: &Thresholds<T>,
        tally: &mut impl Tally,
    ) -> usize {
        // Copies, here and below: behind references they might alias what is written, which bars SIMD.
        let gate = self.gate[block].0;
        let mut before = self.transmittance[block].0;
        let mut done = 0;
        for weights in &mut self.weights[splats] {
            let (shares, left) = blend::<T, FMA>(&weights.0, &gate, &before, thresholds);
            if any(&left, |left| thresholds.stops(left)) {
                break;
            }
            for i in 0..LANES {
                tally.blended(weights.0[i] >= gate[i]);
                weights.0[i] = shares[i] * before[i];
                before[i] = left[i];
            }
            done += 1;
        }
        self.transmittance[block].0 = before;
        done
    }

    /// Closes the pixels of a block that stop before a splat, which has a place in the list; returns whether others are left.
    #[inline(always)]
    fn stop_pixels<const FMA: bool>(
        &mut self,
        block: usize,
        number: usize,
        place: i32,
        thresholds: &Thresholds<T>,
    ) -> bool {
        let (mut gate, mut stop) = (self.gate[block].0, self.stop[block].0);
        let before = self.transmittance[block].0;
        let (_, left) = blend::<T, FMA>(&self.weights[number].0, &gate, &before, thresholds);
        let closed = T::of(f64::INFINITY);
        for i in 0..LANES {
            let stops = thresholds.stops(left[i]);
            gate[i] = if stops { closed } else { gate[i] };
            stop[i] = if stops { place } else { stop[i] };
        }
        (self.gate[block].0, self.stop[block].0) = (gate, stop);
        any(&gate, |gate| gate < closed)
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

/// The alpha of a splat at each pixel that takes its light, and the transmittance behind it.
#[inline(always)]
fn blend<T: Real, const FMA: bool>(
    raw: &Lanes<T>,
    gate: &Lanes<T>,
    before: &Lanes<T>,
    thresholds: &Thresholds<T>,
) -> (Lanes<T>, Lanes<T>) {
    let [mut shares, mut left] = [[T::ZERO; LANES]; 2];
    for i in 0..LANES {
        // Every store is unconditional: masked ones are slow. Without a share nothing changes, exactly.
        let alpha = thresholds.alpha(raw[i]);
        shares[i] = if raw[i] >= gate[i] { alpha } else { T::ZERO };
        left[i] = T::multiply_add::<FMA>(-shares[i], before[i], before[i]);
    }
    (shares, left)
}
