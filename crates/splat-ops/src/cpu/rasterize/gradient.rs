//! Walks the splats of a tile back to front and collects their gradients.
//!
//! ```text
//! d alpha = T (c . grad - B)
//! g = d sigma = -raw d alpha = alpha T (B - c . grad)     (0 at the cap)
//! ```
//!
//! T being the transmittance in front of the splat, and B what its pixel shows behind it, as the
//! loss sees it, were there nothing in front: `B = background . grad - grad of alpha` behind the
//! last splat, and `B (1 - alpha) + (c . grad) alpha` in front of each. T is found front to back,
//! as when blending, so nothing is ever divided by one less alpha.
//!
//! Everything that a splat's shape needs is six sums over its pixels, of g times 1, z1, z2, z1^2,
//! z1 z2 and z2^2. z is of the order of one wherever the splat is seen, so nothing cancels, however
//! thin or far away it is. With dx = z1 / w11 and dy = (z2 - w21 dx) / w22:
//!
//! ```text
//! d o   = -sum(g) / o                 d mean = -(w11 sum(g z1) + w21 sum(g z2), w22 sum(g z2))
//! d w11 = sum(g z1^2) / w11           d w22  = (sum(g z2^2) - w21 / w11 sum(g z1 z2)) / w22
//! d w21 = sum(g z1 z2) / w11
//! ```
//!
//! The absolute gradients of the mean (Ye et al. 2024, *AbsGS*) are two sums more, where they are
//! asked for: of `|g (w11 z1 + w21 z2)|` and of `|g z2|`.

use core::ops::Range;

use macerator::{Simd, Vector};

use super::super::real::Real;
use super::super::simd::prefetch;
use super::super::tiles::TILE;
use super::batch::{Batch, ByPlace, by_groups};
use super::pixels::{Columns, Pixels, four_totals, load_each, total};
use super::splat::{
    ABSOLUTE, ACROSS, Aligned, BATCH, BLOCKS, Centres, GROUP, LANES, Lanes, MOMENTS, SIDE, Splat,
    Thresholds, corner, in_blocks, row_mut, row_of, shape_sums, square,
};
use super::trace::{ByBlock, TileTrace};
use super::view::View;

/// The pixels of a tile while they are walked back to front, by block. `ABS`: absolute gradients
/// are asked for.
pub(super) struct GradientTile<S: Simd, T: Real, const ABS: bool> {
    /// B, behind the splats that are still to come.
    behind: ByBlock<T>,
    /// D of each block: gradient of the image.
    grad: Vec<Aligned<Lanes<T>>>,
    batch: Batch<T>,
    /// Values of every splat that reaches the block at hand.
    pairs: Vec<Aligned<Pairs<T>>>,
    /// c . grad of the same, of channels beyond the first group.
    toward: Vec<Aligned<Lanes<T>>>,
    /// Sums of each splat of the batch, whose lanes are added last: those of its shape and the
    /// first group of channels.
    sums: Box<ByPlace<Sums<S, T>>>,
    /// Likewise of the further channels.
    further_sums: Vec<Vector<S, T>>,
}

/// By fours, to which they are added up.
type Sums<S, T> = Aligned<[Vector<S, T>; (shape_sums(true) + GROUP).next_multiple_of(4)]>;

/// A splat and each pixel of a block.
#[derive(Clone, Copy)]
struct Pairs<T> {
    /// By column.
    z1: Lanes<T>,
    z2: Lanes<T>,
    /// `|z|^2`, and then alpha where the splat is blended, 0 elsewhere.
    share: Lanes<T>,
    /// The share of the pixel's light that the splat sends, alpha T.
    weight: Lanes<T>,
}

impl<S: Simd, T: Real, const ABS: bool> GradientTile<S, T, ABS> {
    /// Sums per splat before those of its colours.
    const SHAPE_SUMS: usize = shape_sums(ABS);

    pub(super) fn new(channels: usize) -> Self {
        let none = [T::ZERO; LANES];
        let pairs = Pairs {
            z1: none,
            z2: none,
            share: none,
            weight: none,
        };
        let further = channels.saturating_sub(GROUP);
        Self {
            behind: [Aligned(none); BLOCKS],
            grad: vec![Aligned(none); channels * BLOCKS],
            batch: Batch::new(channels),
            pairs: vec![Aligned(pairs); BATCH],
            toward: vec![Aligned(none); if further > 0 { BATCH } else { 0 }],
            sums: Box::new([Aligned([T::ZERO.splat(); _]); _]),
            further_sums: vec![T::ZERO.splat(); BATCH * further],
        }
    }

    /// Reads the gradient of the tile's pixels, and adds its share of the background's gradient,
    /// `sum of T_final grad`, if there is one.
    #[inline(always)]
    pub(super) fn load(
        &mut self,
        view: &View<T>,
        grad: &[T],
        [tx, ty]: [usize; 2],
        trace: &TileTrace<T>,
        background: &mut [T],
    ) {
        let [columns, rows] = view.inside([tx, ty]);
        if [columns, rows] != [TILE; 2] {
            // Nobody looks at pixels outside of the image.
            self.behind = [Aligned([T::ZERO; LANES]); BLOCKS];
            self.grad.fill(Aligned([T::ZERO; LANES]));
        }
        let depth = view.channels + 1;
        for row in 0..rows {
            let first = (ty * TILE + row) * view.width + tx * TILE;
            // The same row of the next tile, which lies anywhere.
            prefetch(grad, (first + TILE) * depth..(first + 2 * TILE) * depth);
            self.load_row(
                row,
                &grad[first * depth..(first + columns) * depth],
                view.channels,
            );
        }
        self.begin(view, trace, background);
    }

    /// Reads a row of the tile; gradients of alpha take the place of B.
    #[inline(always)]
    fn load_row(&mut self, row: usize, grad: &[T], channels: usize) {
        let first = row / SIDE * ACROSS;
        let (whole, rest) = match channels {
            3 => grad.as_chunks::<{ 4 * SIDE }>(),
            _ => (&[][..], grad),
        };
        let blocks = self.grad.as_chunks_mut::<3>().0.iter_mut();
        let blocks = blocks.zip(&mut self.behind).skip(first);
        for (grad, (planes, behind)) in whole.iter().zip(blocks) {
            let pixels = core::array::from_fn(|i| row_of(grad, i));
            let [red, green, blue, alpha] = T::transposed(pixels);
            for (plane, values) in planes.iter_mut().zip([red, green, blue]) {
                *row_mut(&mut plane.0, row % SIDE) = values;
            }
            *row_mut(&mut behind.0, row % SIDE) = alpha;
        }
        self.load_pixels(row, SIDE * whole.len(), rest, channels);
    }

    /// Reads pixels of a row of the tile, of any number of channels, from a column on.
    // By itself: what its loops need to remember would take the registers of the other one.
    #[inline(never)]
    fn load_pixels(&mut self, row: usize, column: usize, grad: &[T], channels: usize) {
        for (i, grad) in grad.chunks_exact(channels + 1).enumerate() {
            let [block, lane] = in_blocks(column + i, row);
            let planes = &mut self.grad[block * channels..];
            for (plane, grad) in planes.iter_mut().zip(&grad[..channels]) {
                plane.0[lane] = *grad;
            }
            self.behind[block].0[lane] = grad[channels];
        }
    }

    /// B behind the last splat of every pixel, and what the background's gradient gets of the tile.
    #[inline(always)]
    fn begin(&mut self, view: &View<T>, trace: &TileTrace<T>, background: &mut [T]) {
        let zero = Pixels::<S, T>::splat(T::ZERO);
        let colors = view.background.zip(trace.transmittance.last());
        for (block, Aligned(behind)) in self.behind.iter_mut().enumerate() {
            let mut sum = zero.minus(Pixels::load(behind));
            if let Some((colors, left)) = colors {
                let left = Pixels::load(&left[block].0);
                let grads = &self.grad[block * view.channels..];
                for ((grad, color), share) in grads.iter().zip(colors).zip(&mut *background) {
                    let grad = Pixels::load(&grad.0);
                    sum = grad.times_plus(Pixels::splat(*color), sum);
                    let mut of_background = T::ZERO.splat();
                    left.times_add_to(grad, &mut of_background);
                    *share += total(of_background);
                }
            }
            sum.store(behind);
        }
    }

    /// Walks the list back to front and writes the sums of each splat over the tile,
    /// `shape_sums(ABS) + D` values. The splats reach the blocks that the forward pass found.
    #[inline(always)]
    pub(super) fn walk(
        &mut self,
        view: &View<T>,
        [tx, ty]: [usize; 2],
        trace: &TileTrace<T>,
        partials: &mut [T],
    ) {
        let [list, beside] = [tx, tx + 1].map(|tx| view.list([tx, ty]));
        let channels = view.channels;
        let thresholds = Thresholds::<T>::new(view.args);
        let corner = corner([tx, ty]);
        let batches = list.chunks(BATCH).zip(trace.reached.chunks(BATCH));
        let batches = batches.zip(partials.chunks_mut(BATCH * (Self::SHAPE_SUMS + channels)));
        let next = [beside.chunks(BATCH).next_back().unwrap_or_default()].into_iter();
        let next = next.chain(list.chunks(BATCH)).rev().skip(1);
        for ((number, ((part, reached), partials)), next) in batches.enumerate().rev().zip(next) {
            self.batch.gather(view, part, next);
            self.batch.places.fill(reached);
            self.clear_sums(part.len(), channels);
            let first = (number * BATCH) as i32;
            for block in 0..BLOCKS {
                let stop = &trace.stop[block].0;
                let [open, count] = self.counts(block, first, stop);
                if count == 0 {
                    continue;
                }
                // In front of the first batch there is all light.
                let before = number.checked_sub(1);
                let before = before.and_then(|before| trace.transmittance.get(before));
                let before = before.map(|before| &before[block].0);
                self.evaluate(block, count, corner);
                self.share::<false>(block, 0..open, first, stop, &thresholds);
                self.share::<true>(block, open..count, first, stop, &thresholds);
                self.weigh(count, before.unwrap_or(&[T::ONE; LANES]));
                by_groups!(self.look(GROUP..channels, channels, block, count));
                match channels {
                    1 => self.step::<1, false>(block, count, channels, &thresholds),
                    2 => self.step::<2, false>(block, count, channels, &thresholds),
                    3 => self.step::<3, false>(block, count, channels, &thresholds),
                    GROUP => self.step::<GROUP, false>(block, count, channels, &thresholds),
                    _ => self.step::<GROUP, true>(block, count, channels, &thresholds),
                }
                by_groups!(self.add_colors(GROUP..channels, channels, block, count));
            }
            self.write_sums(channels, partials);
        }
    }

    #[inline(always)]
    fn clear_sums(&mut self, splats: usize, channels: usize) {
        let zero = T::ZERO.splat();
        for Aligned(sums) in &mut self.sums[..splats] {
            *sums = [zero; _];
        }
        self.further_sums[..splats * channels.saturating_sub(GROUP)].fill(zero);
    }

    #[inline(always)]
    fn write_sums(&self, channels: usize, partials: &mut [T]) {
        let together = Self::SHAPE_SUMS + channels.min(GROUP);
        let further = channels.saturating_sub(GROUP);
        let partials = partials.chunks_exact_mut(Self::SHAPE_SUMS + channels);
        for (place, (partials, Aligned(sums))) in partials.zip(&*self.sums).enumerate() {
            let (first, rest) = partials.split_at_mut(together);
            let mut totals = [[T::ZERO; 4]; 3];
            for (totals, sums) in totals.iter_mut().zip(sums.as_chunks().0) {
                *totals = four_totals(*sums);
            }
            first.copy_from_slice(&totals.as_flattened()[..together]);
            let sums = &self.further_sums[place * further..][..further];
            for (out, sum) in rest.iter_mut().zip(sums) {
                *out = total(*sum);
            }
        }
    }

    /// How many splats of the batch, which begins at a place of the list, reach a block before its
    /// first pixel stopped, and before its last one did.
    #[inline(always)]
    fn counts(&self, block: usize, first: i32, stop: &Lanes<i32>) -> [usize; 2] {
        let places = self.batch.places.of(block);
        let end = first + BATCH as i32;
        // Most pixels never stop. One loop that always ends, as SIMD code.
        if stop.iter().fold(true, |all, stop| all & (*stop >= end)) {
            return [places.len(); 2];
        }
        let (mut soonest, mut last) = (i32::MAX, 0);
        for stop in stop {
            (soonest, last) = (soonest.min(*stop), last.max(*stop));
        }
        let before = |stop| places.partition_point(|place| first + i32::from(*place) < stop);
        [before(soonest), before(last)]
    }

    /// z and its square of the first splats that reach a block.
    #[inline(always)]
    fn evaluate(&mut self, block: usize, count: usize, corner: [T; 2]) {
        let centres = Centres::<S, T>::new(block, corner);
        let pairs = &mut self.pairs[..count];
        for (Aligned(pairs), splat) in pairs.iter_mut().zip(self.batch.reaching(block, 0..count)) {
            let (z1, z2) = splat.z(&centres);
            z1.store(&mut pairs.z1);
            z2.store(&mut pairs.z2);
            square(z1, z2).store(&mut pairs.share);
        }
    }

    /// Shares of some of the splats. `STOPS` if a pixel may have stopped before one of them.
    // By themselves: the processor looks only so far ahead for other pairs to work on, and an
    // exponential is long.
    #[inline(always)]
    fn share<const STOPS: bool>(
        &mut self,
        block: usize,
        splats: Range<usize>,
        first: i32,
        stop: &Lanes<i32>,
        thresholds: &Thresholds<T>,
    ) {
        let gate = Pixels::<S, T>::splat(thresholds.alpha_min);
        // From the first place on, where numbers are small.
        let until = stop.map(|stop| {
            let until = stop.saturating_sub(first).clamp(0, BATCH as i32);
            T::of_index(until)
        });
        let until = Pixels::load(&until);
        let places = &self.batch.places.of(block)[splats.clone()];
        for (Aligned(pairs), place) in self.pairs[splats].iter_mut().zip(places) {
            let falloffs = Pixels::load(&pairs.share).exp2_neg();
            let raw = self.batch.splat(*place).raw(falloffs);
            let mut share = thresholds.share(raw, gate);
            if STOPS {
                let place = Pixels::splat(T::of_index(i32::from(*place)));
                share = share.where_below(place, until);
            }
            share.store(&mut pairs.share);
        }
    }

    /// Weights of the first splats that reach a block, front to back, given the transmittance in
    /// front of them.
    #[inline(always)]
    fn weigh(&mut self, count: usize, before: &Lanes<T>) {
        let mut before = Pixels::<S, T>::load(before);
        for Aligned(pairs) in &mut self.pairs[..count] {
            let share = Pixels::load(&pairs.share);
            share.times(before).store(&mut pairs.weight);
            before = share.times_from(before, before);
        }
    }

    /// Share of some further channels of the splats' colours in the loss at every pixel, c . grad.
    #[inline(always)]
    fn look<const COUNT: usize>(
        &mut self,
        first: usize,
        channels: usize,
        block: usize,
        count: usize,
    ) {
        let grads = self.grads::<COUNT>(block * channels + first);
        let colors = self.batch.colors(block, first);
        for (Aligned(toward), color) in self.toward[..count].iter_mut().zip(colors) {
            let before = match first {
                GROUP => Pixels::splat(T::ZERO),
                _ => Pixels::load(toward),
            };
            dot(&grads, &color, before).store(toward);
        }
    }

    /// Gradient of some channels of a block's pixels.
    #[inline(always)]
    fn grads<const COUNT: usize>(&self, first: usize) -> [Pixels<S, T>; COUNT] {
        load_each(&self.grad[first..])
    }

    /// Steps in front of the first splats that reach a block, the last one first, and adds what
    /// they get to their sums: their moments and the first group of channels. Whether there are
    /// `MORE` channels.
    #[inline(always)]
    fn step<const COUNT: usize, const MORE: bool>(
        &mut self,
        block: usize,
        count: usize,
        channels: usize,
        thresholds: &Thresholds<T>,
    ) {
        let mut behind = Pixels::<S, T>::load(&self.behind[block].0);
        let grads = self.grads::<COUNT>(block * channels);
        let places = self.batch.places.of(block);
        let pairs = self.pairs[..count].iter().zip(places).enumerate();
        for (number, (Aligned(pairs), place)) in pairs.rev() {
            let further = match MORE {
                true => Pixels::load(&self.toward[number].0),
                false => Pixels::splat(T::ZERO),
            };
            let toward = dot(&grads, &self.batch.splat(*place).color, further);
            let (share, weight) = (Pixels::load(&pairs.share), Pixels::load(&pairs.weight));
            let difference = behind.minus(toward);
            let g = thresholds.below_cap(weight.times(difference), share);
            behind = share.times_from(difference, behind);

            let Aligned(sums) = &mut self.sums[usize::from(*place)];
            let (shape, of_colors) = sums.split_at_mut(Self::SHAPE_SUMS);
            let (moments, absolute) = shape.split_at_mut(MOMENTS);
            add_moments(g, pairs, moments);
            if ABS {
                add_absolute(g, pairs, &self.batch.splat(*place), absolute);
            }
            for (sum, grad) in of_colors.iter_mut().zip(grads) {
                weight.times_add_to(grad, sum);
            }
        }
        behind.store(&mut self.behind[block].0);
    }

    /// Adds a block's weights times the gradient of some further channels.
    #[inline(always)]
    fn add_colors<const COUNT: usize>(
        &mut self,
        first: usize,
        channels: usize,
        block: usize,
        count: usize,
    ) {
        let grads = self.grads::<COUNT>(block * channels + first);
        let places = self.batch.places.of(block);
        for (Aligned(pairs), place) in self.pairs[..count].iter().zip(places) {
            let at = usize::from(*place) * (channels - GROUP) + first - GROUP;
            let weight = Pixels::load(&pairs.weight);
            for (sum, grad) in self.further_sums[at..at + COUNT].iter_mut().zip(grads) {
                weight.times_add_to(grad, sum);
            }
        }
    }
}

/// `sum + c . grad` of some channels.
#[inline(always)]
fn dot<S: Simd, T: Real, const COUNT: usize>(
    grads: &[Pixels<S, T>; COUNT],
    color: &[T; GROUP],
    sum: Pixels<S, T>,
) -> Pixels<S, T> {
    let mut sum = sum;
    for (grad, color) in grads.iter().zip(color) {
        sum = grad.times_plus(Pixels::splat(*color), sum);
    }
    sum
}

/// Adds a block's g times 1, z1, z2, z1^2, z1 z2 and z2^2.
#[inline(always)]
fn add_moments<S: Simd, T: Real>(g: Pixels<S, T>, pairs: &Pairs<T>, sums: &mut [Vector<S, T>]) {
    let (z1, z2) = (Columns::load(&pairs.z1), Pixels::load(&pairs.z2));
    // z1 is that of all rows.
    let by_z2 = g.times(z2);
    let (one, two) = (g.column_sums(), by_z2.column_sums());
    let one_by_z1 = one.times(z1);
    one.add_to(&mut sums[0]);
    one_by_z1.add_to(&mut sums[1]);
    two.add_to(&mut sums[2]);
    one_by_z1.times_add_to(z1, &mut sums[3]);
    two.times_add_to(z1, &mut sums[4]);
    by_z2.times_add_to(z2, &mut sums[5]);
}

/// Adds a block's `|g (w11 z1 + w21 z2)|` and `|g z2|`.
#[inline(always)]
fn add_absolute<S: Simd, T: Real>(
    g: Pixels<S, T>,
    pairs: &Pairs<T>,
    splat: &Splat<T>,
    sums: &mut [Vector<S, T>],
) {
    let (z1, z2) = (Columns::load(&pairs.z1), Pixels::load(&pairs.z2));
    let across = z1.times(Columns::splat(splat.w11)).pixels();
    let across = z2.times_plus(Pixels::splat(splat.w21), across);
    let values: [_; ABSOLUTE] = [g.times(across), g.times(z2)];
    for (value, sum) in values.into_iter().zip(sums) {
        value.magnitudes().column_sums().add_to(sum);
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, Tensor, TensorData};

    use super::*;
    use crate::{ImageSize, Projected, RasterizeSettings, rasterize};

    /// Faint splats as wide as can be, the light of whose pixels ends in the second batch: each
    /// splat's weight is alpha times what the ones before it leave, and nothing from there on.
    #[test]
    fn light_that_ends_behind_the_first_batch_ends_there_in_the_gradient_too() {
        let (count, alpha, size) = (
            3 * BATCH,
            0.05f32,
            ImageSize {
                width: 5,
                height: 3,
            },
        );
        let device = Device::flex().autodiff();
        let rows = (0..count).flat_map(|i| {
            let depth = 1.0 + i as f32;
            [2.5, 1.5, depth, 1e-4, 0.0, 1e-4, 1.0, 1e5, 1e5]
        });
        let packed = TensorData::new(rows.collect::<Vec<f32>>(), [1, count, 9]);
        let projected = Projected::from_packed(Tensor::from_data(packed, &device), size).unwrap();
        let colors = Tensor::<2>::ones([count, 1], &device).require_grad();
        let opacities = Tensor::<1>::full([count], alpha, &device);
        let settings = RasterizeSettings::default();
        let rendered = rasterize(&projected, colors.clone(), opacities, None, &settings).unwrap();
        let grads = rendered.image().sum().backward();
        let weights = colors.grad(&grads).unwrap().into_data();
        let weights = weights.try_into_vec::<f32>().unwrap();

        let (mut left, mut last) = (1.0f64, 0);
        for (place, weight) in weights.iter().enumerate() {
            let after = left * f64::from(1.0 - alpha);
            let stopped = after < f64::from(settings.transmittance_min as f32);
            let expected = if stopped { 0.0 } else { 15.0 * (left - after) };
            let error = (f64::from(*weight) - expected).abs();
            assert!(
                error <= 1e-4 * expected,
                "splat {place}: {weight}, not {expected}"
            );
            if !stopped {
                (left, last) = (after, place);
            }
        }
        assert!(
            (BATCH..2 * BATCH).contains(&last),
            "the last splat is {last}"
        );
    }
}
