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
use super::super::simd::prefetch;
use super::View;
use super::blocks::Blocks;
use super::splat::{AHEAD, Centres, LANES, Lanes, PLANE, Splat, Thresholds, block, block_mut};

/// Sums per splat before those of its D colours.
pub(super) const MOMENTS: usize = 6;

/// Per-pixel data of one camera that the backward starts from.
pub(super) struct Upstream<'a, T> {
    pub(super) grad: &'a [T],
    pub(super) transmittance: &'a [T],
    pub(super) stop: &'a [i32],
}

/// The pixels of a tile while they are walked back to front.
pub(super) struct GradientTile<T> {
    /// Transmittance behind the splats walked so far; in front of them after the next one.
    transmittance: [T; PLANE],
    /// What lies behind, as the loss sees it: sum of (c . grad) alpha T over the splats behind, plus
    /// the final transmittance times (background . grad - grad of alpha).
    behind: [T; PLANE],
    /// The place of the splat before which the pixel stopped.
    stop: [i32; PLANE],
    /// D planes: gradient of the image.
    grad: Vec<[T; PLANE]>,
}

impl<T: Real> GradientTile<T> {
    pub(super) fn new(channels: usize) -> Self {
        Self {
            transmittance: [T::ONE; PLANE],
            behind: [T::ZERO; PLANE],
            stop: [0; PLANE],
            grad: vec![[T::ZERO; PLANE]; channels],
        }
    }

    /// Reads the tile's pixels, and adds its share of the background's gradient, `sum of T_final grad`. Pixels outside
    /// of the image have blended nothing.
    #[inline(always)]
    pub(super) fn load(
        &mut self,
        view: &View<T>,
        upstream: &Upstream<T>,
        [tx, ty]: [usize; 2],
        channels: usize,
        background: &mut [T],
    ) {
        self.transmittance = [T::ONE; PLANE];
        self.behind = [T::ZERO; PLANE];
        self.stop = [0; PLANE];
        self.grad.fill([T::ZERO; PLANE]);
        let [columns, rows] = view.inside([tx, ty]);
        for row in 0..rows {
            for column in 0..columns {
                let at = row * TILE + column;
                let pixel = (ty * TILE + row) * view.width + tx * TILE + column;
                let grad = &upstream.grad[pixel * (channels + 1)..(pixel + 1) * (channels + 1)];
                let left = upstream.transmittance[pixel];
                let mut behind = -grad[channels];
                for channel in 0..channels {
                    self.grad[channel][at] = grad[channel];
                    background[channel] += left * grad[channel];
                    if let Some(color) = view.background {
                        behind += color[channel] * grad[channel];
                    }
                }
                self.transmittance[at] = left;
                self.behind[at] = left * behind;
                self.stop[at] = upstream.stop[pixel];
            }
        }
    }

    /// Walks the list back to front and writes the sums of each splat over the tile, `MOMENTS + D` values. The list's pairs
    /// have the `blocks` from the `first` on, which end at the given one.
    #[inline(always)]
    pub(super) fn walk<const FMA: bool>(
        &mut self,
        view: &View<T>,
        list: &[u32],
        tile: [usize; 2],
        channels: usize,
        (blocks, first, mut end): (&Blocks, usize, usize),
        partials: &mut [T],
    ) {
        let width = MOMENTS + channels;
        let thresholds = Thresholds::<T>::new(view.args);
        let centres = Centres::<T>::new(tile);
        let mut color_sums = vec![[T::ZERO; LANES]; channels];

        for (place, index) in list.iter().enumerate().rev() {
            let index = *index as usize;
            let splat = &view.splats[index];
            let color = &view.colors[index * channels..][..channels];
            let next = list.get(place.wrapping_sub(AHEAD));
            prefetch(view.splats, next.map(|index| *index as usize));
            let mut sums = [[T::ZERO; LANES]; MOMENTS];
            color_sums.fill([T::ZERO; LANES]);
            for at in blocks.before(&mut end, first + place) {
                self.step::<FMA>(
                    splat,
                    color,
                    &centres,
                    *at,
                    place as i32,
                    &thresholds,
                    &mut sums,
                    &mut color_sums,
                );
            }
            // Or else the compiler takes the lanes apart for the totals already in the loop.
            let (sums, color_sums) = core::hint::black_box((&sums, &color_sums));
            let out = &mut partials[place * width..(place + 1) * width];
            for (out, lanes) in out.iter_mut().zip(sums.iter().chain(color_sums)) {
                *out = total(lanes);
            }
        }
    }

    /// Steps in front of one splat in the block that begins `at` a pixel, and adds to its sums.
    #[inline(always)]
    fn step<const FMA: bool>(
        &mut self,
        splat: &Splat<T>,
        color: &[T],
        centres: &Centres<T>,
        at: u8,
        place: i32,
        thresholds: &Thresholds<T>,
        sums: &mut [Lanes<T>; MOMENTS],
        color_sums: &mut [Lanes<T>],
    ) {
        let (dx, dy) = centres.from(splat.mean, at);
        let w22_dy = splat.along_y(dy);
        let planes = &self.grad[..color.len()];
        let mut color_grad = [T::ZERO; LANES];
        for (plane, color) in planes.iter().zip(color) {
            let (lanes, color) = (block(plane, at), *color);
            for i in 0..LANES {
                color_grad[i] = T::multiply_add::<FMA>(color, lanes[i], color_grad[i]);
            }
        }
        // Copies: behind references they might alias what is written, which bars SIMD.
        let mut transmittance = *block(&self.transmittance, at);
        let (mut behind, stop) = (*block(&self.behind, at), *block(&self.stop, at));
        let [mut one, mut z1s, mut z2s, mut z11, mut z12, mut z22] = *sums;
        let mut weights = [T::ZERO; LANES];
        for i in 0..LANES {
            let (z1, z2, falloff) = splat.falloff::<FMA>(dx[i], w22_dy);
            let raw = splat.opacity * falloff;
            let blended = thresholds.seen(raw) & (place < stop[i]);
            // Every store is unconditional: masked ones are slow. Without a share nothing changes, exactly.
            let share = if blended {
                thresholds.alpha(raw)
            } else {
                T::ZERO
            };
            let inverse = T::ONE / (T::ONE - share);
            let before = transmittance[i] * inverse;
            let weight = share * before;
            let dalpha = before * color_grad[i] - behind[i] * inverse;
            let live = blended & !thresholds.capped(raw);
            let g = if live { -raw * dalpha } else { T::ZERO };
            weights[i] = weight;
            behind[i] = T::multiply_add::<FMA>(weight, color_grad[i], behind[i]);
            transmittance[i] = before;

            let (g1, g2) = (g * z1, g * z2);
            one[i] += g;
            z1s[i] += g1;
            z2s[i] += g2;
            z11[i] = T::multiply_add::<FMA>(g1, z1, z11[i]);
            z12[i] = T::multiply_add::<FMA>(g1, z2, z12[i]);
            z22[i] = T::multiply_add::<FMA>(g2, z2, z22[i]);
        }
        *block_mut(&mut self.transmittance, at) = transmittance;
        *block_mut(&mut self.behind, at) = behind;
        *sums = [one, z1s, z2s, z11, z12, z22];
        for (sum, plane) in color_sums[..color.len()].iter_mut().zip(planes) {
            let (lanes, mut total) = (block(plane, at), *sum);
            for i in 0..LANES {
                total[i] = T::multiply_add::<FMA>(weights[i], lanes[i], total[i]);
            }
            *sum = total;
        }
    }
}

/// Sum over the lanes: halves are added to halves.
#[inline(always)]
fn total<T: Real>(lanes: &Lanes<T>) -> T {
    let (mut sums, mut width) = (*lanes, LANES);
    while width > 1 {
        width /= 2;
        for i in 0..width {
            sums[i] += sums[i + width];
        }
    }
    sums[0]
}
