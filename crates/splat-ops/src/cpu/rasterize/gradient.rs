//! Walks the splats of a tile back to front and collects their gradients.
//!
//! ```text
//! d alpha = T (c . grad) - behind / (1 - alpha)
//! g = d sigma = -raw d alpha     (0 at the cap)
//! ```
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

use super::super::intersect::TILE;
use super::super::real::Real;
use super::View;
use super::batch::{BATCH, Batch, by_groups};
use super::splat::{Aligned, BLOCKS, LANES, Lanes, Thresholds, centres, corner, in_blocks, square};

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
    batch: Batch<T>,
    /// Of every splat that reaches the block at hand.
    pairs: Vec<Aligned<Pairs<T>>>,
    /// `MOMENTS + D` sums of each splat of the batch, each in parts that are added last.
    sums: Vec<Aligned<Parts<T>>>,
}

/// A sum over pixels, in as many parts as there are pixels in half a block.
type Parts<T> = [T; LANES / 2];

/// A splat and each pixel of a block.
#[derive(Clone, Copy)]
struct Pairs<T> {
    z1: Lanes<T>,
    z2: Lanes<T>,
    /// Raw alpha, and then g.
    raw: Lanes<T>,
    /// c . grad, and then the splat's weight.
    toward: Lanes<T>,
}

impl<T: Real> GradientTile<T> {
    pub(super) fn new(channels: usize) -> Self {
        let none = [T::ZERO; LANES];
        let pairs = Pairs {
            z1: none,
            z2: none,
            raw: none,
            toward: none,
        };
        Self {
            transmittance: [Aligned([T::ONE; LANES]); BLOCKS],
            behind: [Aligned(none); BLOCKS],
            stop: [Aligned([0; LANES]); BLOCKS],
            grad: vec![Aligned(none); channels * BLOCKS],
            batch: Batch::new(),
            pairs: vec![Aligned(pairs); BATCH],
            sums: vec![Aligned([T::ZERO; LANES / 2]); BATCH * (MOMENTS + channels)],
        }
    }

    /// Reads the tile's pixels, and adds its share of the background's gradient, `sum of T_final grad`, if there is one.
    /// Pixels outside of the image have blended nothing.
    #[inline(always)]
    pub(super) fn load(
        &mut self,
        view: &View<T>,
        upstream: &Upstream<T>,
        tile: [usize; 2],
        background: &mut [T],
    ) {
        // With a number of channels that the compiler knows, their loops are unrolled.
        match view.channels {
            3 => self.load_channels(view, upstream, tile, 3, background),
            channels => self.load_channels(view, upstream, tile, channels, background),
        }
    }

    #[inline(always)]
    fn load_channels(
        &mut self,
        view: &View<T>,
        upstream: &Upstream<T>,
        [tx, ty]: [usize; 2],
        channels: usize,
        background: &mut [T],
    ) {
        self.transmittance = [Aligned([T::ONE; LANES]); BLOCKS];
        self.behind = [Aligned([T::ZERO; LANES]); BLOCKS];
        self.stop = [Aligned([0; LANES]); BLOCKS];
        self.grad.fill(Aligned([T::ZERO; LANES]));
        let [columns, rows] = view.inside([tx, ty]);
        for row in 0..rows {
            for column in 0..columns {
                let [block, lane] = in_blocks(column, row);
                let pixel = (ty * TILE + row) * view.width + tx * TILE + column;
                let grad = &upstream.grad[pixel * (channels + 1)..(pixel + 1) * (channels + 1)];
                let left = upstream.transmittance[pixel];
                let mut behind = -grad[channels];
                for channel in 0..channels {
                    self.grad[block * channels + channel].0[lane] = grad[channel];
                    if let Some(color) = view.background {
                        behind += color[channel] * grad[channel];
                        background[channel] += left * grad[channel];
                    }
                }
                self.transmittance[block].0[lane] = left;
                self.behind[block].0[lane] = left * behind;
                self.stop[block].0[lane] = upstream.stop[pixel];
            }
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
            self.sums[..list.len() * width].fill(Aligned([T::ZERO; LANES / 2]));
            let first = (number * BATCH) as i32;
            for block in 0..BLOCKS {
                let count = self.count(block, first);
                if count > 0 {
                    self.evaluate::<FMA>(block, count, corner);
                    by_groups!(self.look::<FMA>(channels, view, list, block, count));
                    self.step::<FMA>(block, count, first, &thresholds);
                    self.add_moments::<FMA>(block, count, width);
                    by_groups!(self.add_colors::<FMA>(channels, channels, block, count));
                }
            }
            for (out, Aligned(parts)) in partials.iter_mut().zip(&self.sums) {
                *out = total(parts);
            }
        }
    }

    /// How many splats of the batch, which begins at a place of the list, reach a block before its last pixel stopped.
    #[inline(always)]
    fn count(&self, block: usize, first: i32) -> usize {
        let stop = self.stop[block]
            .0
            .iter()
            .fold(0, |last, stop| last.max(*stop));
        let places = self.batch.places.of(block);
        let is_behind = |place: &&u8| first + i32::from(**place) >= stop;
        places.len() - places.iter().rev().take_while(is_behind).count()
    }

    /// Raw alphas of the first splats that reach a block.
    #[inline(always)]
    fn evaluate<const FMA: bool>(&mut self, block: usize, count: usize, corner: [T; 2]) {
        let [xs, ys] = centres(corner, block);
        let pairs = &mut self.pairs[..count];
        for (Aligned(pairs), splat) in pairs.iter_mut().zip(self.batch.reaching(block)) {
            for i in 0..LANES {
                [pairs.z1[i], pairs.z2[i]] = splat.z::<FMA>(xs[i], ys[i]);
            }
        }
        // By itself, so that all that an exponential needs stays in registers.
        for (Aligned(pairs), splat) in pairs.iter_mut().zip(self.batch.reaching(block)) {
            for i in 0..LANES {
                let square = square::<T, FMA>([pairs.z1[i], pairs.z2[i]]);
                pairs.raw[i] = splat.raw::<FMA>(square);
            }
        }
    }

    /// What the loss thinks of the splats' colours at every pixel, c . grad.
    #[inline(always)]
    fn look<const FMA: bool, const GROUP: usize>(
        &mut self,
        first: usize,
        view: &View<T>,
        list: &[u32],
        block: usize,
        count: usize,
    ) {
        let planes = &self.grad[block * view.channels + first..][..GROUP];
        let grads: [Lanes<T>; GROUP] = core::array::from_fn(|i| planes[i].0);
        let places = self.batch.places.of(block);
        for (Aligned(pairs), place) in self.pairs[..count].iter_mut().zip(places) {
            let colors = view.colors::<GROUP>(list[usize::from(*place)], first);
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

    /// Steps in front of the splats, the last one first: their weights and g.
    #[inline(always)]
    fn step<const FMA: bool>(
        &mut self,
        block: usize,
        count: usize,
        first: i32,
        thresholds: &Thresholds<T>,
    ) {
        let (mut transmittance, mut behind) = (self.transmittance[block].0, self.behind[block].0);
        let stop = self.stop[block].0;
        let places = &self.batch.places.of(block)[..count];
        for (Aligned(pairs), place) in self.pairs[..count].iter_mut().zip(places).rev() {
            let (raw, toward) = (pairs.raw, pairs.toward);
            let place = first + i32::from(*place);
            let [mut weights, mut gs] = [[T::ZERO; LANES]; 2];
            for i in 0..LANES {
                let blended = thresholds.seen(raw[i]) & (place < stop[i]);
                // Every store is unconditional: masked ones are slow. Without a share nothing changes, exactly.
                let share = if blended {
                    thresholds.alpha(raw[i])
                } else {
                    T::ZERO
                };
                let inverse = T::ONE / (T::ONE - share);
                let before = transmittance[i] * inverse;
                let dalpha = before * toward[i] - behind[i] * inverse;
                let live = blended & !thresholds.capped(raw[i]);
                gs[i] = if live { -raw[i] * dalpha } else { T::ZERO };
                weights[i] = share * before;
                behind[i] = T::multiply_add::<FMA>(weights[i], toward[i], behind[i]);
                transmittance[i] = before;
            }
            (pairs.raw, pairs.toward) = (gs, weights);
        }
        (self.transmittance[block].0, self.behind[block].0) = (transmittance, behind);
    }

    /// Adds a block's g times 1, z1, z2, z1^2, z1 z2 and z2^2.
    #[inline(always)]
    fn add_moments<const FMA: bool>(&mut self, block: usize, count: usize, width: usize) {
        let places = self.batch.places.of(block);
        for (Aligned(pairs), place) in self.pairs[..count].iter().zip(places) {
            let sums = &mut self.sums[usize::from(*place) * width..][..MOMENTS];
            let mut parts: [Parts<T>; MOMENTS] = core::array::from_fn(|i| sums[i].0);
            let Pairs { z1, z2, raw: g, .. } = *pairs;
            for half in [0, LANES / 2] {
                for part in 0..LANES / 2 {
                    let i = half + part;
                    let (g1, g2) = (g[i] * z1[i], g[i] * z2[i]);
                    parts[0][part] += g[i];
                    parts[1][part] += g1;
                    parts[2][part] += g2;
                    parts[3][part] = T::multiply_add::<FMA>(g1, z1[i], parts[3][part]);
                    parts[4][part] = T::multiply_add::<FMA>(g1, z2[i], parts[4][part]);
                    parts[5][part] = T::multiply_add::<FMA>(g2, z2[i], parts[5][part]);
                }
            }
            for (sum, parts) in sums.iter_mut().zip(parts) {
                sum.0 = parts;
            }
        }
    }

    /// Adds a block's weights times the gradient of the image.
    #[inline(always)]
    fn add_colors<const FMA: bool, const GROUP: usize>(
        &mut self,
        first: usize,
        channels: usize,
        block: usize,
        count: usize,
    ) {
        let planes = &self.grad[block * channels + first..][..GROUP];
        let grads: [Lanes<T>; GROUP] = core::array::from_fn(|i| planes[i].0);
        let width = MOMENTS + channels;
        let places = self.batch.places.of(block);
        for (Aligned(pairs), place) in self.pairs[..count].iter().zip(places) {
            let at = usize::from(*place) * width + MOMENTS + first;
            let sums = &mut self.sums[at..at + GROUP];
            let weights = pairs.toward;
            for (sum, grad) in sums.iter_mut().zip(&grads) {
                let mut parts = sum.0;
                for half in [0, LANES / 2] {
                    for part in 0..LANES / 2 {
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
fn total<T: Real>(parts: &Parts<T>) -> T {
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
