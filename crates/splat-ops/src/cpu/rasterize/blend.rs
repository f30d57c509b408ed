//! Blends the splats of a tile, front to back.
//!
//! Block by block, and each block in three passes over the splats that reach it: falloffs, which depend on nothing
//! else; weights, one splat after the other; colours, a product of matrices. Each is a short loop, of which the processor
//! has several turns under way at once. All in one, it would wait for every exponential.

use core::ops::Range;

use super::super::intersect::TILE;
use super::super::real::Real;
use super::batch::{BATCH, Batch, GROUP, Reached, by_groups};
use super::splat::{
    Aligned, BLOCKS, Centres, HALF, LANES, Lanes, SIDE, Thresholds, any_less, corner, in_blocks,
    squares,
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
    centres: [Centres<T>; BLOCKS],
    batch: Batch<T>,
    /// Of every splat that reaches the block at hand: `|z|^2`, then falloffs, then weights.
    weights: [Aligned<Lanes<T>>; BATCH],
}

impl<T: Real> BlendTile<T> {
    pub(super) fn new(channels: usize) -> Self {
        Self {
            transmittance: [Aligned([T::ONE; LANES]); BLOCKS],
            gate: [Aligned([T::of(f64::INFINITY); LANES]); BLOCKS],
            stop: [Aligned([i32::MAX; LANES]); BLOCKS],
            colors: vec![Aligned([T::ZERO; LANES]); channels * BLOCKS],
            centres: Centres::of_blocks(),
            batch: Batch::new(channels),
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
                by_groups!(self.add_colors::<FMA>(channels, channels, block, count));
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

    /// Falloffs of the splats that reach a block.
    #[inline(always)]
    fn evaluate<const FMA: bool>(
        &mut self,
        block: usize,
        corner: [T; 2],
        thresholds: &Thresholds<T>,
        tally: &mut impl Tally,
    ) {
        let Centres { x, y } = self.centres[block].beyond(corner);
        let count = self.batch.places.of(block).len();
        let weights = &mut self.weights[..count];
        for (weights, splat) in weights.iter_mut().zip(self.batch.reaching(block, 0..count)) {
            for i in 0..HALF {
                let (z1, z2) = splat.z::<FMA>(x[i], [y[0][i], y[1][i]]);
                [weights.0[i], weights.0[HALF + i]] = squares::<T, FMA>(z1, z2);
            }
        }
        // By themselves, so that all that an exponential needs stays in registers.
        for (weights, splat) in weights.iter_mut().zip(self.batch.reaching(block, 0..count)) {
            for i in 0..LANES {
                weights.0[i] = T::exp2_neg::<FMA>(weights.0[i]);
            }
            for raw in splat.raw(&weights.0) {
                tally.tested(thresholds.seen(raw));
            }
        }
    }

    /// Turns falloffs into weights, the share of a pixel's light that each splat sends. The list's batch begins at a
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
        let reaching = self.batch.reaching(block, splats.clone());
        for (weights, splat) in self.weights[splats].iter_mut().zip(reaching) {
            let raw = splat.raw(&weights.0);
            let (shares, left) = blend::<T, FMA>(&raw, &gate, &before, thresholds);
            if thresholds.any_stops(&left) {
                break;
            }
            for i in 0..LANES {
                tally.blended(raw[i] >= gate[i]);
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
        let splat = self.batch.splat(self.batch.places.of(block)[number]);
        let raw = splat.raw(&self.weights[number].0);
        let (_, left) = blend::<T, FMA>(&raw, &gate, &before, thresholds);
        let closed = T::of(f64::INFINITY);
        for i in 0..LANES {
            let stops = thresholds.stops(left[i]);
            gate[i] = if stops { closed } else { gate[i] };
            stop[i] = if stops { place } else { stop[i] };
        }
        (self.gate[block].0, self.stop[block].0) = (gate, stop);
        any_less(&gate, closed)
    }

    /// Adds the colours of the first splats that reach a block, times their weights.
    #[inline(always)]
    fn add_colors<const FMA: bool, const COUNT: usize>(
        &mut self,
        first: usize,
        channels: usize,
        block: usize,
        count: usize,
    ) {
        let planes = &mut self.colors[block * channels + first..][..COUNT];
        let mut sums: [Lanes<T>; COUNT] = core::array::from_fn(|i| planes[i].0);
        let colors = self.batch.colors(block, first);
        for (weights, colors) in self.weights[..count].iter().zip(colors) {
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
        let [columns, rows] = view.inside([tx, ty]);
        for row in 0..rows {
            for column in (0..columns).step_by(SIDE) {
                let from = in_blocks(column, row);
                let pixel = row * view.width + tx * TILE + column;
                // With numbers that the compiler knows, loops are unrolled.
                match (view.channels, columns - column) {
                    (3, SIDE..) => self.store_row(view, from, pixel, slab, 3, SIDE),
                    (d, width) => self.store_row(view, from, pixel, slab, d, width.min(SIDE)),
                }
            }
        }
    }

    /// Writes some pixels of a row of a block.
    #[inline(always)]
    fn store_row(
        &self,
        view: &View<T>,
        [block, lane]: [usize; 2],
        pixel: usize,
        slab: &mut Slab<T>,
        channels: usize,
        width: usize,
    ) {
        let row = lane / SIDE;
        let left = in_row(&self.transmittance[block].0, row);
        let pixels = pixel..pixel + width;
        slab.transmittance[pixels.clone()].copy_from_slice(&left[..width]);
        slab.stop[pixels].copy_from_slice(&in_row(&self.stop[block].0, row)[..width]);
        let image = &mut slab.image[pixel * (channels + 1)..][..width * (channels + 1)];
        for channel in 0..channels {
            let behind = view.background.map_or(T::ZERO, |b| b[channel]);
            let colors = in_row(&self.colors[block * channels + channel].0, row);
            for i in 0..width {
                image[i * (channels + 1) + channel] = colors[i] + left[i] * behind;
            }
        }
        for i in 0..width {
            image[i * (channels + 1) + channels] = T::ONE - left[i];
        }
    }
}

/// The lanes of a row of a block, and no more: a copy of all would be read before it is written.
#[inline(always)]
fn in_row<V: Copy>(lanes: &Lanes<V>, row: usize) -> [V; SIDE] {
    let (rows, _) = lanes.as_chunks::<SIDE>();
    rows[row]
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
