//! Blends the splats of a tile, front to back.

use super::super::intersect::TILE;
use super::super::real::Real;
use super::splat::{BLOCKS, HALVES, LANES, Lanes, Splat, Thresholds, half_of, pixel_centres};
use super::{Slab, View};

/// After so many splats it is looked which blocks still take light.
const LOOK: usize = 8;

/// What a block's pixels carry along.
#[derive(Clone, Copy)]
struct Block<T> {
    transmittance: Lanes<T>,
    /// The least raw alpha that still counts: `alpha_min`, infinity once the pixel has stopped or where
    /// there is none.
    gate: Lanes<T>,
    /// The place of the splat before which the pixel stopped; `u32::MAX` while it has not.
    stop: Lanes<u32>,
}

/// The pixels of a tile while it is being blended.
pub(super) struct BlendTile<T> {
    /// D lanes per block.
    colors: Vec<Lanes<T>>,
    blocks: [Block<T>; BLOCKS],
}

impl<T: Real> BlendTile<T> {
    #[inline(always)]
    pub(super) fn blend<const FMA: bool>(
        view: &View<T>,
        ranks: &[u32],
        tx: usize,
        ty: usize,
    ) -> Self {
        let d = view.channels;
        let thresholds = Thresholds::<T>::new(view.args);
        let (xs, ys) = (pixel_centres::<T>(tx * TILE), pixel_centres::<T>(ty * TILE));
        let halves: [Lanes<T>; HALVES] = core::array::from_fn(|half| half_of(&xs, half));
        let (columns, rows) = view.inside(tx, ty);
        let closed = T::of(f64::INFINITY);
        let mut tile = Self {
            colors: vec![[T::ZERO; LANES]; BLOCKS * d],
            blocks: core::array::from_fn(|block| {
                let (row, half) = (block / HALVES, block % HALVES);
                let exists = |i: usize| row < rows && half * LANES + i < columns;
                Block {
                    transmittance: [T::ONE; LANES],
                    gate: core::array::from_fn(|i| {
                        if exists(i) {
                            thresholds.alpha_min
                        } else {
                            closed
                        }
                    }),
                    stop: [u32::MAX; LANES],
                }
            }),
        };
        let mut open = tile.open_blocks(closed);

        for (place, rank) in ranks.iter().enumerate() {
            let splat = &view.splats[*rank as usize];
            let color = &view.colors[*rank as usize * d..(*rank as usize + 1) * d];
            let (from, to) = splat.spans(&ys);
            for row in splat.rows(ty * TILE) {
                let w22_dy = splat.w22 * (ys[row] - splat.mean[1]);
                for half in 0..HALVES {
                    let (x, block) = (&halves[half], row * HALVES + half);
                    if !(open[block] && to[row] >= x[0] && from[row] <= x[LANES - 1]) {
                        continue;
                    }
                    tile.blocks[block].add::<FMA>(
                        splat,
                        color,
                        x,
                        w22_dy,
                        place as u32,
                        &thresholds,
                        &mut tile.colors[block * d..(block + 1) * d],
                    );
                }
            }
            if place % LOOK == LOOK - 1 {
                open = tile.open_blocks(closed);
                if !open.contains(&true) {
                    break;
                }
            }
        }
        tile
    }

    #[inline(always)]
    fn open_blocks(&self, closed: T) -> [bool; BLOCKS] {
        let mut open = [false; BLOCKS];
        for (open, block) in open.iter_mut().zip(&self.blocks) {
            // Integers, because a loop that ends early would not vectorise.
            let mut any = 0;
            for gate in &block.gate {
                any |= u32::from(*gate < closed);
            }
            *open = any != 0;
        }
        open
    }

    /// Writes the tile into its row of tiles, with the background behind it.
    #[inline(always)]
    pub(super) fn store(&self, view: &View<T>, tx: usize, ty: usize, slab: &mut Slab<T>) {
        let d = view.channels;
        let (columns, rows) = view.inside(tx, ty);
        for row in 0..rows {
            for column in 0..columns {
                let (block, i) = (row * HALVES + column / LANES, column % LANES);
                let pixel = row * view.width + tx * TILE + column;
                let left = self.blocks[block].transmittance[i];
                let out = &mut slab.image[pixel * (d + 1)..(pixel + 1) * (d + 1)];
                for channel in 0..d {
                    let behind = view.background.map_or(T::ZERO, |b| b[channel]);
                    out[channel] = self.colors[block * d + channel][i] + left * behind;
                }
                out[d] = T::ONE - left;
                slab.transmittance[pixel] = left;
                slab.stop[pixel] = self.blocks[block].stop[i];
            }
        }
    }
}

impl<T: Real> Block<T> {
    /// Blends one splat into the block's pixels.
    #[inline(always)]
    fn add<const FMA: bool>(
        &mut self,
        splat: &Splat<T>,
        color: &[T],
        x: &Lanes<T>,
        w22_dy: T,
        place: u32,
        thresholds: &Thresholds<T>,
        colors: &mut [Lanes<T>],
    ) {
        let closed = T::of(f64::INFINITY);
        let mut weights = [T::ZERO; LANES];
        // Copies: behind the references they might alias what is written, which bars SIMD.
        let Block {
            transmittance: mut left,
            gate,
            ..
        } = *self;
        let mut stopped = [0u32; LANES];
        let mut any_stopped = 0;
        for i in 0..LANES {
            let (_, _, falloff) = splat.falloff::<FMA>(x[i] - splat.mean[0], w22_dy);
            let raw = splat.opacity * falloff;
            let alpha = thresholds.alpha(raw);
            let seen = raw >= gate[i];
            let stops = thresholds.stops(left[i] * (T::ONE - alpha));
            // Every store is unconditional: masked ones are slow. Without a share nothing changes, exactly.
            let share = if seen & !stops { alpha } else { T::ZERO };
            weights[i] = share * left[i];
            left[i] = left[i] * (T::ONE - share);
            stopped[i] = u32::from(seen & stops);
            any_stopped |= stopped[i];
        }
        self.transmittance = left;
        // Once in a pixel's life.
        if any_stopped != 0 {
            for i in 0..LANES {
                if stopped[i] != 0 {
                    self.gate[i] = closed;
                    self.stop[i] = place;
                }
            }
        }
        for (lanes, color) in colors.iter_mut().zip(color) {
            let color = *color;
            for i in 0..LANES {
                lanes[i] = T::multiply_add::<FMA>(color, weights[i], lanes[i]);
            }
        }
    }
}
