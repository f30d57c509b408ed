//! Walks the splats of a tile back to front and collects their gradients.
//!
//! ```text
//! d alpha = T (c . grad) - behind / (1 - alpha)
//! d o = exp(-sigma) d alpha,  d sigma = -raw d alpha     (both 0 at the cap)
//! d z = z d sigma;  d w11 = dz1 dx;  d w21 = dz2 dx;  d w22 = dz2 dy
//! d mean = -(w11 dz1 + w21 dz2, w22 dz2)
//! ```

use super::super::intersect::TILE;
use super::super::real::Real;
use super::splat::{BLOCKS, HALVES, LANES, Lanes, Splat, Thresholds, half_of, pixel_centres};
use super::{GEOMETRY, View};

/// Per-pixel data of one camera that the backward starts from.
pub(super) struct Upstream<'a, T> {
    pub(super) grad: &'a [T],
    pub(super) transmittance: &'a [T],
    pub(super) stop: &'a [u32],
}

/// What a block's pixels carry along.
#[derive(Clone, Copy)]
struct Block<T> {
    /// Transmittance behind the splats walked so far; in front of them after the next one.
    transmittance: Lanes<T>,
    /// What lies behind, as the loss sees it: sum of (c . grad) alpha T over the splats behind, plus
    /// the final transmittance times (background . grad - grad of alpha).
    behind: Lanes<T>,
    /// The place of the splat before which the pixel stopped.
    stop: Lanes<u32>,
}

/// Sums of a splat's gradients over the pixels of a tile, one per lane.
struct Sums<T> {
    z1: Lanes<T>,
    z2: Lanes<T>,
    w11: Lanes<T>,
    w21: Lanes<T>,
    w22: Lanes<T>,
    opacity: Lanes<T>,
}

/// The pixels of a tile while they are walked back to front.
pub(super) struct GradientTile<T> {
    /// Gradient of the D colours, D lanes per block.
    grad: Vec<Lanes<T>>,
    blocks: [Block<T>; BLOCKS],
}

impl<T: Real> GradientTile<T> {
    /// Reads the tile's pixels, and adds its share of the background's gradient, `sum of T_final grad`.
    #[inline(always)]
    pub(super) fn load(
        view: &View<T>,
        upstream: &Upstream<T>,
        tx: usize,
        ty: usize,
        background: &mut [T],
    ) -> Self {
        let d = view.channels;
        let (columns, rows) = view.inside(tx, ty);
        let nothing = Block {
            transmittance: [T::ONE; LANES],
            behind: [T::ZERO; LANES],
            stop: [0; LANES],
        };
        let mut tile = Self {
            grad: vec![[T::ZERO; LANES]; BLOCKS * d],
            blocks: [nothing; BLOCKS],
        };
        for row in 0..rows {
            for column in 0..columns {
                let (block, i) = (row * HALVES + column / LANES, column % LANES);
                let pixel = (ty * TILE + row) * view.width + tx * TILE + column;
                let grad = &upstream.grad[pixel * (d + 1)..(pixel + 1) * (d + 1)];
                let left = upstream.transmittance[pixel];
                let mut behind = -grad[d];
                for channel in 0..d {
                    tile.grad[block * d + channel][i] = grad[channel];
                    background[channel] += left * grad[channel];
                    if let Some(color) = view.background {
                        behind += color[channel] * grad[channel];
                    }
                }
                let block = &mut tile.blocks[block];
                block.transmittance[i] = left;
                block.behind[i] = left * behind;
                block.stop[i] = upstream.stop[pixel];
            }
        }
        tile
    }

    /// Walks the list back to front and writes the partial gradients of each splat, `6 + D` values.
    #[inline(always)]
    pub(super) fn walk<const FMA: bool>(
        mut self,
        view: &View<T>,
        ranks: &[u32],
        tx: usize,
        ty: usize,
        partials: &mut [T],
    ) {
        let d = view.channels;
        let thresholds = Thresholds::<T>::new(view.args);
        let (xs, ys) = (pixel_centres::<T>(tx * TILE), pixel_centres::<T>(ty * TILE));
        let halves: [Lanes<T>; HALVES] = core::array::from_fn(|half| half_of(&xs, half));
        // One past the last place that any pixel of the block has blended.
        let mut ends = [0usize; BLOCKS];
        for (end, block) in ends.iter_mut().zip(&self.blocks) {
            let latest = block.stop.iter().fold(0, |latest, stop| latest.max(*stop));
            *end = ranks.len().min(latest as usize);
        }
        let depth = ends.into_iter().fold(0, usize::max);
        let mut color_sums = vec![[T::ZERO; LANES]; d];

        for place in (0..depth).rev() {
            let rank = ranks[place] as usize;
            let splat = &view.splats[rank];
            let color = &view.colors[rank * d..(rank + 1) * d];
            let (from, to) = splat.spans(&ys);
            let mut sums = Sums::zero();
            color_sums.fill([T::ZERO; LANES]);
            for row in splat.rows(ty * TILE) {
                let dy = ys[row] - splat.mean[1];
                for half in 0..HALVES {
                    let (x, block) = (&halves[half], row * HALVES + half);
                    if !(place < ends[block] && to[row] >= x[0] && from[row] <= x[LANES - 1]) {
                        continue;
                    }
                    self.blocks[block].step::<FMA>(
                        splat,
                        color,
                        x,
                        dy,
                        place as u32,
                        &thresholds,
                        &self.grad[block * d..(block + 1) * d],
                        &mut sums,
                        &mut color_sums,
                    );
                }
            }
            let out = &mut partials[place * (GEOMETRY + d)..(place + 1) * (GEOMETRY + d)];
            out[..GEOMETRY].copy_from_slice(&sums.total(splat));
            for (out, lanes) in out[GEOMETRY..].iter_mut().zip(&color_sums) {
                *out = total(lanes);
            }
        }
    }
}

impl<T: Real> Block<T> {
    /// Steps in front of one splat, and adds its gradients at the block's pixels.
    #[inline(always)]
    fn step<const FMA: bool>(
        &mut self,
        splat: &Splat<T>,
        color: &[T],
        x: &Lanes<T>,
        dy: T,
        place: u32,
        thresholds: &Thresholds<T>,
        grad: &[Lanes<T>],
        sums: &mut Sums<T>,
        color_sums: &mut [Lanes<T>],
    ) {
        let w22_dy = splat.w22 * dy;
        let mut color_grad = [T::ZERO; LANES];
        for (lanes, color) in grad.iter().zip(color) {
            let color = *color;
            for i in 0..LANES {
                color_grad[i] = T::multiply_add::<FMA>(color, lanes[i], color_grad[i]);
            }
        }
        let mut weights = [T::ZERO; LANES];
        // Copies: behind the references they might alias what is written, which bars SIMD.
        let Block {
            mut transmittance,
            mut behind,
            stop,
        } = *self;
        let Sums {
            mut z1,
            mut z2,
            mut w11,
            mut w21,
            mut w22,
            mut opacity,
        } = *sums;
        for i in 0..LANES {
            let dx = x[i] - splat.mean[0];
            let (u1, u2, falloff) = splat.falloff::<FMA>(dx, w22_dy);
            let raw = splat.opacity * falloff;
            let alpha = thresholds.alpha(raw);
            let blended = thresholds.seen(raw) & (place < stop[i]);
            // Every store is unconditional: masked ones are slow. Without a share nothing changes, exactly.
            let share = if blended { alpha } else { T::ZERO };
            let inverse = T::ONE / (T::ONE - share);
            let before = transmittance[i] * inverse;
            let weight = share * before;
            let dalpha = before * color_grad[i] - behind[i] * inverse;
            let draw = if blended & !thresholds.capped(raw) {
                dalpha
            } else {
                T::ZERO
            };
            weights[i] = weight;
            behind[i] = T::multiply_add::<FMA>(weight, color_grad[i], behind[i]);
            transmittance[i] = before;

            let dsigma = -raw * draw;
            let (dz1, dz2) = (u1 * dsigma, u2 * dsigma);
            opacity[i] = T::multiply_add::<FMA>(falloff, draw, opacity[i]);
            z1[i] += dz1;
            z2[i] += dz2;
            w11[i] = T::multiply_add::<FMA>(dz1, dx, w11[i]);
            w21[i] = T::multiply_add::<FMA>(dz2, dx, w21[i]);
            w22[i] = T::multiply_add::<FMA>(dz2, dy, w22[i]);
        }
        self.transmittance = transmittance;
        self.behind = behind;
        *sums = Sums {
            z1,
            z2,
            w11,
            w21,
            w22,
            opacity,
        };
        for (sum, lanes) in color_sums.iter_mut().zip(grad) {
            for i in 0..LANES {
                sum[i] = T::multiply_add::<FMA>(weights[i], lanes[i], sum[i]);
            }
        }
    }
}

impl<T: Real> Sums<T> {
    #[inline(always)]
    fn zero() -> Self {
        let zero = [T::ZERO; LANES];
        Self {
            z1: zero,
            z2: zero,
            w11: zero,
            w21: zero,
            w22: zero,
            opacity: zero,
        }
    }

    /// Gradients of screen mean, w11, w21, w22 and opacity.
    #[inline(always)]
    fn total(&self, splat: &Splat<T>) -> [T; GEOMETRY] {
        let (dz1, dz2) = (total(&self.z1), total(&self.z2));
        [
            -(splat.w11 * dz1 + splat.w21 * dz2),
            -(splat.w22 * dz2),
            total(&self.w11),
            total(&self.w21),
            total(&self.w22),
            total(&self.opacity),
        ]
    }
}

#[inline(always)]
fn total<T: Real>(lanes: &Lanes<T>) -> T {
    lanes.iter().copied().sum()
}
