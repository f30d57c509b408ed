//! Blends the splats of a tile, front to back.
//!
//! Block by block, and each block in three passes over the splats that reach it: distances and
//! falloffs, which depend on nothing else; then weights and colours, one splat after the other.
//! Each is a short loop, of which the processor has several turns under way at once. All in one, it
//! would wait for every exponential.

use core::ops::Range;

use macerator::Simd;

use super::super::real::Real;
use super::super::tiles::TILE;
use super::batch::{Batch, by_groups};
use super::pixels::{Pixels, load_each};
use super::splat::{
    ACROSS, Aligned, BATCH, BLOCKS, Centres, GROUP, LANES, Lanes, SIDE, Thresholds, corner,
    in_blocks, row_of, square,
};
use super::tally::Tally;
use super::trace::{ByBlock, Trace};
use super::view::View;

/// The pixels of a tile while it is being blended, by block.
pub(super) struct BlendTile<T> {
    transmittance: ByBlock<T>,
    /// The least raw alpha that still counts: `alpha_min`, infinity once the pixel has stopped or
    /// where there is none.
    gate: ByBlock<T>,
    /// The place of the splat before which the pixel stopped; `i32::MAX` while it has not.
    stop: ByBlock<i32>,
    /// D of each block.
    colors: Vec<Aligned<Lanes<T>>>,
    batch: Batch<T>,
    /// Values of every splat that reaches the block at hand: `|z|^2`, then falloffs, then weights.
    weights: [Aligned<Lanes<T>>; BATCH],
}

impl<T: Real> BlendTile<T> {
    pub(super) fn new(channels: usize) -> Self {
        Self {
            transmittance: [Aligned([T::ONE; LANES]); BLOCKS],
            gate: [Aligned([T::of(f64::INFINITY); LANES]); BLOCKS],
            stop: [Aligned([i32::MAX; LANES]); BLOCKS],
            colors: vec![Aligned([T::ZERO; LANES]); channels * BLOCKS],
            batch: Batch::new(channels),
            weights: [Aligned([T::ZERO; LANES]); BATCH],
        }
    }

    /// Starts a tile anew and blends the splats of its list.
    #[inline(always)]
    pub(super) fn blend<S: Simd>(
        &mut self,
        view: &View<T>,
        [tx, ty]: [usize; 2],
        trace: &mut Trace<T>,
        tally: &mut impl Tally,
    ) {
        let [list, beside] = [tx, tx + 1].map(|tx| view.list([tx, ty]));
        let thresholds = Thresholds::<T>::new(view.args);
        let (corner, channels) = (corner([tx, ty]), view.channels);
        let mut open = self.begin(view.inside([tx, ty]), &thresholds);
        let end = trace.reached.len() + list.len();

        let next = [beside.chunks(BATCH).next().unwrap_or_default()];
        let next = list.chunks(BATCH).skip(1).chain(next);
        for (number, (part, next)) in list.chunks(BATCH).zip(next).enumerate() {
            if number > 0 {
                trace.transmittance.push(self.transmittance);
            }
            let splats = self.batch.gather(view, part, next);
            let first = trace.reached.len();
            trace.reached.resize(first + splats.len(), 0);
            let reached = &mut trace.reached[first..];
            for (blocks, splat) in reached.iter_mut().zip(splats) {
                *blocks = splat.blocks(corner) & open;
            }
            self.batch.places.fill(reached);
            for block in 0..BLOCKS {
                if open >> block & 1 == 0 {
                    continue;
                }
                self.evaluate::<S>(block, corner, &thresholds, tally);
                let place = (number * BATCH) as i32;
                let (count, is_open) = self.shine::<S>(block, place, channels, &thresholds, tally);
                by_groups!(self.add_colors::<S>(GROUP..channels, channels, block, count));
                if !is_open {
                    open &= !(1 << block);
                }
            }
            if open == 0 {
                break;
            }
        }
        trace.reached.resize(end, 0);
        if view.background.is_some() {
            trace.transmittance.push(self.transmittance);
        }
        trace.end_tile(&self.stop);
    }

    /// Clears the tile; returns which blocks have pixels, a bit for each.
    #[inline(always)]
    fn begin(&mut self, [columns, rows]: [usize; 2], thresholds: &Thresholds<T>) -> u16 {
        self.transmittance = [Aligned([T::ONE; LANES]); BLOCKS];
        self.stop = [Aligned([i32::MAX; LANES]); BLOCKS];
        self.colors.fill(Aligned([T::ZERO; LANES]));
        if [columns, rows] == [TILE; 2] {
            self.gate = [Aligned([thresholds.alpha_min; LANES]); BLOCKS];
            return u16::MAX;
        }
        self.gate = [Aligned([T::of(f64::INFINITY); LANES]); BLOCKS];
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
    fn evaluate<S: Simd>(
        &mut self,
        block: usize,
        corner: [T; 2],
        thresholds: &Thresholds<T>,
        tally: &mut impl Tally,
    ) {
        let centres = Centres::<S, T>::new(block, corner);
        let count = self.batch.places.of(block).len();
        let weights = &mut self.weights[..count];
        for (weights, splat) in weights.iter_mut().zip(self.batch.reaching(block, 0..count)) {
            let (z1, z2) = splat.z(&centres);
            square(z1, z2).store(&mut weights.0);
        }
        // By themselves: the processor looks only so far ahead for other pairs to work on, and an
        // exponential is long.
        for weights in &mut *weights {
            let squares = Pixels::<S, T>::load(&weights.0);
            squares.exp2_neg().store(&mut weights.0);
        }
        for (weights, splat) in weights.iter().zip(self.batch.reaching(block, 0..count)) {
            let raw = || splat.raw(Pixels::<S, T>::load(&weights.0));
            tally.tested(|| of_each(raw(), Pixels::splat(thresholds.alpha_min)));
        }
    }

    /// Sends the light of the splats that reach a block to its pixels, the first group of its
    /// channels. The list's batch begins at a `place`. Returns how many splats there are until all
    /// pixels of the block have stopped, and whether any has not.
    #[inline(always)]
    fn shine<S: Simd>(
        &mut self,
        block: usize,
        place: i32,
        channels: usize,
        thresholds: &Thresholds<T>,
        tally: &mut impl Tally,
    ) -> (usize, bool) {
        let count = self.batch.places.of(block).len();
        let mut done = 0;
        loop {
            let splats = done..count;
            done += match channels {
                1 => self.shine_until_stop::<S, 1>(block, splats, channels, thresholds, tally),
                2 => self.shine_until_stop::<S, 2>(block, splats, channels, thresholds, tally),
                3 => self.shine_until_stop::<S, 3>(block, splats, channels, thresholds, tally),
                _ => self.shine_until_stop::<S, GROUP>(block, splats, channels, thresholds, tally),
            };
            if done == count {
                return (count, true);
            }
            let place = place + i32::from(self.batch.places.of(block)[done]);
            if !self.stop_pixels::<S>(block, done, place, thresholds) {
                return (done, false);
            }
        }
    }

    /// As far as no pixel stops; returns how many splats that are. Where there are more channels
    /// than a group, falloffs turn into weights, the share of a pixel's light that each splat
    /// sends.
    // Stopping is done elsewhere, once in a pixel's life, so that nothing here depends on it:
    // transmittance and colours stay in registers.
    #[inline(always)]
    fn shine_until_stop<S: Simd, const COUNT: usize>(
        &mut self,
        block: usize,
        splats: Range<usize>,
        channels: usize,
        thresholds: &Thresholds<T>,
        tally: &mut impl Tally,
    ) -> usize {
        let gate = Pixels::<S, T>::load(&self.gate[block].0);
        let planes = &mut self.colors[block * channels..][..COUNT];
        let mut light = Light {
            left: Pixels::load(&self.transmittance[block].0),
            colors: load_each::<S, T, COUNT>(planes),
        };
        let mut done = 0;
        let places = &self.batch.places.of(block)[splats.clone()];
        let falloffs = &mut self.weights[splats];
        // Where one register holds a block, there are enough of them to remember what was before
        // several splats, and to ask only behind the last of these whether a pixel stops.
        if T::lanes::<S>() == LANES && channels <= GROUP {
            let fours = places.as_chunks::<4>().0.iter();
            for (places, falloffs) in fours.zip(falloffs.as_chunks::<4>().0) {
                let mut behind = light;
                let mut raws = [gate; 4];
                for i in 0..4 {
                    let splat = self.batch.splat(places[i]);
                    raws[i] = splat.raw(Pixels::load(&falloffs[i].0));
                    behind.pass(thresholds.share(raws[i], gate), &splat.color);
                }
                if behind.left.any_below(thresholds.transmittance_min) {
                    break;
                }
                for raw in raws {
                    tally.blended(|| of_each(raw, gate));
                }
                light = behind;
                done += 4;
            }
        }
        for (place, falloffs) in places[done..].iter().zip(&mut falloffs[done..]) {
            let splat = self.batch.splat(*place);
            let raw = splat.raw(Pixels::load(&falloffs.0));
            let mut behind = light;
            let weights = behind.pass(thresholds.share(raw, gate), &splat.color);
            if behind.left.any_below(thresholds.transmittance_min) {
                break;
            }
            if channels > GROUP {
                weights.store(&mut falloffs.0);
            }
            tally.blended(|| of_each(raw, gate));
            light = behind;
            done += 1;
        }
        light.left.store(&mut self.transmittance[block].0);
        for (plane, color) in planes.iter_mut().zip(light.colors) {
            color.store(&mut plane.0);
        }
        done
    }

    /// Closes the pixels of a block that stop before a splat, which has a place in the list;
    /// returns whether others are left.
    #[inline(always)]
    fn stop_pixels<S: Simd>(
        &mut self,
        block: usize,
        number: usize,
        place: i32,
        thresholds: &Thresholds<T>,
    ) -> bool {
        let (gate, stop) = (&mut self.gate[block].0, &mut self.stop[block].0);
        let before = Pixels::<S, T>::load(&self.transmittance[block].0);
        let splat = self.batch.splat(self.batch.places.of(block)[number]);
        let raw = splat.raw(Pixels::load(&self.weights[number].0));
        let share = thresholds.share(raw, Pixels::load(gate));
        let left = share.times_from(before, before).lanes();
        let closed = T::of(f64::INFINITY);
        let mut are_left = false;
        for i in 0..LANES {
            let stops = thresholds.stops(left[i]);
            gate[i] = if stops { closed } else { gate[i] };
            stop[i] = if stops { place } else { stop[i] };
            are_left |= gate[i] < closed;
        }
        are_left
    }

    /// Adds some further channels of the colours of the first splats that reach a block, times
    /// their weights.
    #[inline(always)]
    fn add_colors<S: Simd, const COUNT: usize>(
        &mut self,
        first: usize,
        channels: usize,
        block: usize,
        count: usize,
    ) {
        let planes = &mut self.colors[block * channels + first..][..COUNT];
        let mut sums = load_each::<S, T, COUNT>(planes);
        let colors = self.batch.colors(block, first);
        for (weights, color) in self.weights[..count].iter().zip(colors) {
            let weights = Pixels::load(&weights.0);
            for (sum, color) in sums.iter_mut().zip(color) {
                *sum = weights.times_plus(Pixels::splat(color), *sum);
            }
        }
        for (plane, sum) in planes.iter_mut().zip(sums) {
            sum.store(&mut plane.0);
        }
    }

    /// Writes the tile into the image of its row of tiles, with the background behind it.
    #[inline(always)]
    pub(super) fn store<S: Simd>(&mut self, view: &View<T>, [tx, ty]: [usize; 2], image: &mut [T]) {
        self.add_background::<S>(view);
        let [columns, rows] = view.inside([tx, ty]);
        let depth = view.channels + 1;
        for row in 0..rows {
            let first = (row * view.width + tx * TILE) * depth;
            self.store_row(
                row,
                &mut image[first..first + columns * depth],
                view.channels,
            );
        }
    }

    #[inline(always)]
    fn add_background<S: Simd>(&mut self, view: &View<T>) {
        let Some(background) = view.background else {
            return;
        };
        let blocks = self.colors.chunks_exact_mut(view.channels);
        for (planes, left) in blocks.zip(&self.transmittance) {
            let left = Pixels::<S, T>::load(&left.0);
            for (plane, color) in planes.iter_mut().zip(background) {
                let plane = &mut plane.0;
                let color = Pixels::splat(*color);
                left.times(color).plus(Pixels::load(plane)).store(plane);
            }
        }
    }

    /// Writes a row of the tile.
    #[inline(always)]
    fn store_row(&self, row: usize, image: &mut [T], channels: usize) {
        let first = row / SIDE * ACROSS;
        let (whole, rest) = match channels {
            3 => image.as_chunks_mut::<{ 4 * SIDE }>(),
            _ => (&mut [][..], image),
        };
        let blocks = self.colors.as_chunks::<3>().0.iter();
        let blocks = blocks.zip(&self.transmittance).skip(first);
        for (pixels, (planes, left)) in whole.iter_mut().zip(blocks) {
            let [red, green, blue] = planes.map(|plane| row_of(&plane.0, row % SIDE));
            let alpha = row_of(&left.0, row % SIDE).map(|left| T::ONE - left);
            let rows = T::transposed([red, green, blue, alpha]);
            pixels.copy_from_slice(rows.as_flattened());
        }
        self.store_pixels(row, SIDE * whole.len(), rest, channels);
    }

    /// Writes pixels of a row of the tile, of any number of channels, from a column on.
    // By itself: what its loops need to remember would take the registers of the other one.
    #[inline(never)]
    fn store_pixels(&self, row: usize, column: usize, image: &mut [T], channels: usize) {
        for (i, pixel) in image.chunks_exact_mut(channels + 1).enumerate() {
            let [block, lane] = in_blocks(column + i, row);
            let (color, alpha) = pixel.split_at_mut(channels);
            for (out, plane) in color.iter_mut().zip(&self.colors[block * channels..]) {
                *out = plane.0[lane];
            }
            alpha[0] = T::ONE - self.transmittance[block].0[lane];
        }
    }
}

/// Light on its way to the pixels of a block, and the part that has arrived.
struct Light<S: Simd, T: Real, const COUNT: usize> {
    /// Transmittance.
    left: Pixels<S, T>,
    /// Colours of a group of channels.
    colors: [Pixels<S, T>; COUNT],
}

impl<S: Simd, T: Real, const COUNT: usize> Clone for Light<S, T, COUNT> {
    #[inline(always)]
    fn clone(&self) -> Self {
        *self
    }
}

impl<S: Simd, T: Real, const COUNT: usize> Copy for Light<S, T, COUNT> {}

impl<S: Simd, T: Real, const COUNT: usize> Light<S, T, COUNT> {
    /// Passes a splat that takes a share of it; returns the share of all light that the splat
    /// sends.
    #[inline(always)]
    fn pass(&mut self, share: Pixels<S, T>, color: &[T; GROUP]) -> Pixels<S, T> {
        let weights = share.times(self.left);
        // Without a share nothing changes, exactly.
        self.left = share.times_from(self.left, self.left);
        for (sum, color) in self.colors.iter_mut().zip(color) {
            *sum = weights.times_plus(Pixels::splat(*color), *sum);
        }
        weights
    }
}

/// Whether raw alphas count, pixel by pixel.
fn of_each<S: Simd, T: Real>(raw: Pixels<S, T>, gate: Pixels<S, T>) -> [bool; LANES] {
    let (raw, gate) = (raw.lanes(), gate.lanes());
    core::array::from_fn(|i| raw[i] >= gate[i])
}
