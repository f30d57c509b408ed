//! Walks the splats of a tile back to front and collects their gradients.
//!
//! ```text
//! d alpha = T (c . grad) - behind / (1 - alpha)
//! g = d sigma = -raw d alpha = raw (behind - T' (c . grad)) / (1 - alpha)     (0 at the cap)
//! ```
//!
//! T being the transmittance in front of the splat, and T' = (1 - alpha) T that behind it.
//!
//! Everything that a splat's shape needs is six sums over its pixels, of g times 1, z1, z2, z1^2, z1 z2 and z2^2. z is of
//! the order of one wherever the splat is seen, so nothing cancels, however thin or far away it is. With dx = z1 / w11
//! and dy = (z2 - w21 dx) / w22:
//!
//! ```text
//! d o   = -sum(g) / o                 d mean = -(w11 sum(g z1) + w21 sum(g z2), w22 sum(g z2))
//! d w11 = sum(g z1^2) / w11           d w22  = (sum(g z2^2) - w21 / w11 sum(g z1 z2)) / w22
//! d w21 = sum(g z1 z2) / w11
//! ```

use core::ops::Range;

use super::super::intersect::TILE;
use super::super::real::Real;
use super::super::simd::prefetch;
use super::View;
use super::batch::{BATCH, Batch, GROUP, by_groups};
use super::splat::{
    Aligned, BLOCKS, Centres, HALF, Half, LANES, Lanes, SIDE, Thresholds, corner, in_blocks,
    squares,
};

/// Sums per splat before those of its D colours.
pub(super) const MOMENTS: usize = 6;

/// Per-pixel data of one camera that the backward starts from.
pub(super) struct Upstream<'a, T> {
    pub(super) grad: &'a [T],
    pub(super) transmittance: &'a [T],
    pub(super) stop: &'a [i32],
}

/// The pixels of a tile while they are walked back to front, by block.
pub(super) struct GradientTile<T> {
    /// Transmittance behind the splats walked so far; in front of them after the next one.
    transmittance: [Aligned<Lanes<T>>; BLOCKS],
    /// What lies behind, as the loss sees it: sum of (c . grad) alpha T over the splats behind, plus
    /// the final transmittance times (background . grad - grad of alpha).
    behind: [Aligned<Lanes<T>>; BLOCKS],
    /// The place of the splat before which the pixel stopped.
    stop: [Aligned<Lanes<i32>>; BLOCKS],
    /// D of each block: gradient of the image.
    grad: Vec<Aligned<Lanes<T>>>,
    centres: [Centres<T>; BLOCKS],
    batch: Batch<T>,
    /// Of every splat that reaches the block at hand.
    pairs: Vec<Aligned<Pairs<T>>>,
    /// `MOMENTS + D` sums of each splat of the batch, each in parts that are added last.
    sums: Vec<Aligned<Half<T>>>,
}

/// A splat and each pixel of a block.
#[derive(Clone, Copy)]
struct Pairs<T> {
    /// Of the upper and of the lower half.
    z1: Half<T>,
    z2: [Half<T>; 2],
    /// `|z|^2`, then the falloff, and then g.
    falloff: Lanes<T>,
    /// c . grad, and then the splat's weight.
    toward: Lanes<T>,
}

impl<T: Real> GradientTile<T> {
    pub(super) fn new(channels: usize) -> Self {
        let none = [T::ZERO; LANES];
        let pairs = Pairs {
            z1: [T::ZERO; HALF],
            z2: [[T::ZERO; HALF]; 2],
            falloff: none,
            toward: none,
        };
        Self {
            transmittance: [Aligned([T::ONE; LANES]); BLOCKS],
            behind: [Aligned(none); BLOCKS],
            stop: [Aligned([0; LANES]); BLOCKS],
            grad: vec![Aligned(none); channels * BLOCKS],
            centres: Centres::of_blocks(),
            batch: Batch::new(channels),
            pairs: vec![Aligned(pairs); BATCH],
            sums: vec![Aligned([T::ZERO; HALF]); BATCH * (MOMENTS + channels)],
        }
    }

    /// Reads the tile's pixels, and adds its share of the background's gradient, `sum of T_final grad`, if there is one.
    /// Pixels outside of the image have blended nothing.
    #[inline(always)]
    pub(super) fn load(
        &mut self,
        view: &View<T>,
        upstream: &Upstream<T>,
        [tx, ty]: [usize; 2],
        background: &mut [T],
    ) {
        let [columns, rows] = view.inside([tx, ty]);
        if [columns, rows] != [TILE; 2] {
            self.transmittance = [Aligned([T::ONE; LANES]); BLOCKS];
            self.behind = [Aligned([T::ZERO; LANES]); BLOCKS];
            self.stop = [Aligned([0; LANES]); BLOCKS];
            self.grad.fill(Aligned([T::ZERO; LANES]));
        }
        for row in 0..rows {
            for column in (0..columns).step_by(SIDE) {
                let to = in_blocks(column, row);
                let pixel = (ty * TILE + row) * view.width + tx * TILE + column;
                // With numbers that the compiler knows, loops are unrolled.
                match (view.channels, columns - column) {
                    (3, SIDE..) => self.load_row(view, upstream, pixel, to, 3, SIDE, background),
                    (d, width) => {
                        let width = width.min(SIDE);
                        self.load_row(view, upstream, pixel, to, d, width, background);
                    }
                }
            }
        }
    }

    /// Reads some pixels of a row of a block.
    #[inline(always)]
    fn load_row(
        &mut self,
        view: &View<T>,
        upstream: &Upstream<T>,
        pixel: usize,
        [block, lane]: [usize; 2],
        channels: usize,
        width: usize,
        background: &mut [T],
    ) {
        // The same rows of the next tile, which lie anywhere.
        let next = pixel + TILE;
        prefetch(upstream.grad, Some(next * (channels + 1)));
        prefetch(upstream.transmittance, Some(next));
        prefetch(upstream.stop, Some(next));
        let pixels = pixel..pixel + width;
        let (left, stop) = (
            &upstream.transmittance[pixels.clone()],
            &upstream.stop[pixels],
        );
        let grad = &upstream.grad[pixel * (channels + 1)..][..width * (channels + 1)];
        let planes = &mut self.grad[block * channels..][..channels];
        let mut behind = [T::ZERO; SIDE];
        for i in 0..width {
            behind[i] = -grad[i * (channels + 1) + channels];
        }
        for channel in 0..channels {
            for i in 0..width {
                planes[channel].0[lane + i] = grad[i * (channels + 1) + channel];
            }
            if let Some(color) = view.background {
                for i in 0..width {
                    let grad = grad[i * (channels + 1) + channel];
                    behind[i] += color[channel] * grad;
                    background[channel] += left[i] * grad;
                }
            }
        }
        for i in 0..width {
            self.transmittance[block].0[lane + i] = left[i];
            self.behind[block].0[lane + i] = left[i] * behind[i];
            self.stop[block].0[lane + i] = stop[i];
        }
    }

    /// Walks the list back to front and writes the sums of each splat over the tile, `MOMENTS + D` values. The splats
    /// reach the blocks that the forward pass found.
    #[inline(always)]
    pub(super) fn walk<const FMA: bool>(
        &mut self,
        view: &View<T>,
        list: &[u32],
        tile: [usize; 2],
        reached: &[u16],
        partials: &mut [T],
    ) {
        let channels = view.channels;
        let width = MOMENTS + channels;
        let thresholds = Thresholds::<T>::new(view.args);
        let corner = corner(tile);
        let batches = list.chunks(BATCH).zip(reached.chunks(BATCH));
        let batches = batches.zip(partials.chunks_mut(BATCH * width));
        for (number, ((list, reached), partials)) in batches.enumerate().rev() {
            self.batch.gather(view, list);
            self.batch.places.fill(reached);
            self.sums[..list.len() * width].fill(Aligned([T::ZERO; HALF]));
            let first = (number * BATCH) as i32;
            for block in 0..BLOCKS {
                let [open, count] = self.counts(block, first);
                if count > 0 {
                    self.evaluate::<FMA>(block, count, corner);
                    by_groups!(self.look::<FMA>(channels, channels, block, count));
                    self.step::<FMA, true>(block, open..count, first, &thresholds);
                    self.step::<FMA, false>(block, 0..open, first, &thresholds);
                    self.add_moments::<FMA>(block, count, width);
                    by_groups!(self.add_colors::<FMA>(channels, channels, block, count));
                }
            }
            for (out, Aligned(parts)) in partials.iter_mut().zip(&self.sums) {
                *out = total(parts);
            }
        }
    }

    /// How many splats of the batch, which begins at a place of the list, reach a block before its first pixel stopped, and
    /// before its last one did.
    #[inline(always)]
    fn counts(&self, block: usize, first: i32) -> [usize; 2] {
        let stop = self.stop[block].0;
        let places = self.batch.places.of(block);
        let end = first + BATCH as i32;
        // Most pixels never stop. One loop that always ends, as SIMD code.
        if stop.iter().fold(true, |all, stop| all & (*stop >= end)) {
            return [places.len(); 2];
        }
        let (mut soonest, mut last) = (i32::MAX, 0);
        for stop in stop {
            (soonest, last) = (soonest.min(stop), last.max(stop));
        }
        let before = |stop| places.partition_point(|place| first + i32::from(*place) < stop);
        [before(soonest), before(last)]
    }

    /// Falloffs of the first splats that reach a block.
    #[inline(always)]
    fn evaluate<const FMA: bool>(&mut self, block: usize, count: usize, corner: [T; 2]) {
        let Centres { x, y } = self.centres[block].beyond(corner);
        let pairs = &mut self.pairs[..count];
        for (Aligned(pairs), splat) in pairs.iter_mut().zip(self.batch.reaching(block, 0..count)) {
            for i in 0..HALF {
                let (z1, z2) = splat.z::<FMA>(x[i], [y[0][i], y[1][i]]);
                pairs.z1[i] = z1;
                [pairs.z2[0][i], pairs.z2[1][i]] = z2;
                [pairs.falloff[i], pairs.falloff[HALF + i]] = squares::<T, FMA>(z1, z2);
            }
        }
        // By themselves, so that all that an exponential needs stays in registers.
        for Aligned(pairs) in pairs {
            for i in 0..LANES {
                pairs.falloff[i] = T::exp2_neg::<FMA>(pairs.falloff[i]);
            }
        }
    }

    /// What the loss thinks of the splats' colours at every pixel, c . grad.
    #[inline(always)]
    fn look<const FMA: bool, const COUNT: usize>(
        &mut self,
        first: usize,
        channels: usize,
        block: usize,
        count: usize,
    ) {
        let planes = &self.grad[block * channels + first..][..COUNT];
        let grads: [Lanes<T>; COUNT] = core::array::from_fn(|i| planes[i].0);
        let colors = self.batch.colors(block, first);
        for (Aligned(pairs), colors) in self.pairs[..count].iter_mut().zip(colors) {
            let mut toward = if first == 0 {
                [T::ZERO; LANES]
            } else {
                pairs.toward
            };
            for (grad, color) in grads.iter().zip(colors) {
                for i in 0..LANES {
                    toward[i] = T::multiply_add::<FMA>(color, grad[i], toward[i]);
                }
            }
            pairs.toward = toward;
        }
    }

    /// Steps in front of some of the splats, the last one first: their weights and g. `STOPS` if a pixel may have stopped
    /// before one of them.
    #[inline(always)]
    fn step<const FMA: bool, const STOPS: bool>(
        &mut self,
        block: usize,
        splats: Range<usize>,
        first: i32,
        thresholds: &Thresholds<T>,
    ) {
        let (mut transmittance, mut behind) = (self.transmittance[block].0, self.behind[block].0);
        let stop = self.stop[block].0;
        let places = &self.batch.places.of(block)[splats.clone()];
        let reaching = self.batch.reaching(block, splats.clone()).zip(places);
        for (Aligned(pairs), (splat, place)) in self.pairs[splats].iter_mut().zip(reaching).rev() {
            let (raw, toward) = (splat.raw(&pairs.falloff), pairs.toward);
            let place = first + i32::from(*place);
            let [mut weights, mut gs] = [[T::ZERO; LANES]; 2];
            for i in 0..LANES {
                let blended = thresholds.seen(raw[i]) & (!STOPS | (place < stop[i]));
                // Every store is unconditional: masked ones are slow. Without a share nothing changes, exactly.
                let share = if blended {
                    thresholds.alpha(raw[i])
                } else {
                    T::ZERO
                };
                let inverse = T::ONE / (T::ONE - share);
                // The T in front is that behind times `inverse`.
                let g = T::multiply_add::<FMA>(-transmittance[i], toward[i], behind[i]);
                let g = raw[i] * inverse * g;
                let live = blended & !thresholds.capped(raw[i]);
                gs[i] = if live { g } else { T::ZERO };
                transmittance[i] = transmittance[i] * inverse;
                weights[i] = share * transmittance[i];
                behind[i] = T::multiply_add::<FMA>(weights[i], toward[i], behind[i]);
            }
            (pairs.falloff, pairs.toward) = (gs, weights);
        }
        (self.transmittance[block].0, self.behind[block].0) = (transmittance, behind);
    }

    /// Adds a block's g times 1, z1, z2, z1^2, z1 z2 and z2^2.
    #[inline(always)]
    fn add_moments<const FMA: bool>(&mut self, block: usize, count: usize, width: usize) {
        let places = self.batch.places.of(block);
        for (Aligned(pairs), place) in self.pairs[..count].iter().zip(places) {
            let sums = &mut self.sums[usize::from(*place) * width..][..MOMENTS];
            let mut parts: [Half<T>; MOMENTS] = core::array::from_fn(|i| sums[i].0);
            let Pairs {
                z1, z2, falloff: g, ..
            } = *pairs;
            for i in 0..HALF {
                // z1 is that of both halves.
                let (upper, lower) = (g[i], g[HALF + i]);
                let (upper2, lower2) = (upper * z2[0][i], lower * z2[1][i]);
                let (one, two) = (upper + lower, upper2 + lower2);
                let one1 = one * z1[i];
                parts[0][i] += one;
                parts[1][i] += one1;
                parts[2][i] += two;
                parts[3][i] = T::multiply_add::<FMA>(one1, z1[i], parts[3][i]);
                parts[4][i] = T::multiply_add::<FMA>(two, z1[i], parts[4][i]);
                parts[5][i] = T::multiply_add::<FMA>(upper2, z2[0][i], parts[5][i]);
                parts[5][i] = T::multiply_add::<FMA>(lower2, z2[1][i], parts[5][i]);
            }
            for (sum, parts) in sums.iter_mut().zip(parts) {
                sum.0 = parts;
            }
        }
    }

    /// Adds a block's weights times the gradient of the image.
    #[inline(always)]
    fn add_colors<const FMA: bool, const COUNT: usize>(
        &mut self,
        first: usize,
        channels: usize,
        block: usize,
        count: usize,
    ) {
        let planes = &self.grad[block * channels + first..][..COUNT];
        let grads: [Lanes<T>; COUNT] = core::array::from_fn(|i| planes[i].0);
        let width = MOMENTS + channels;
        let places = self.batch.places.of(block);
        for (Aligned(pairs), place) in self.pairs[..count].iter().zip(places) {
            let at = usize::from(*place) * width + MOMENTS + first;
            let sums = &mut self.sums[at..at + COUNT];
            let weights = pairs.toward;
            for (sum, grad) in sums.iter_mut().zip(&grads) {
                let mut parts = sum.0;
                for half in [0, HALF] {
                    for part in 0..HALF {
                        let (weight, grad) = (weights[half + part], grad[half + part]);
                        parts[part] = T::multiply_add::<FMA>(weight, grad, parts[part]);
                    }
                }
                sum.0 = parts;
            }
        }
    }
}

/// Sum of the parts: halves are added to halves.
#[inline(always)]
fn total<T: Real>(parts: &Half<T>) -> T {
    let (mut sums, mut width) = (*parts, parts.len());
    while width > 1 {
        width /= 2;
        for i in 0..width {
            sums[i] += sums[i + width];
        }
    }
    sums[0]
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, Tensor, TensorData};

    use super::*;
    use crate::{ImageSize, Projected, RasterizeSettings, rasterize};

    /// Faint splats as wide as can be, the light of whose pixels ends in the second batch: each splat's weight is alpha times
    /// what the ones before it leave, and nothing from there on.
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
