//! A splat as the pixels of a tile see it, and what becomes of a (pixel, splat) pair.

use macerator::Simd;

use super::super::real::Real;
use super::super::splat::UNIT;
pub(super) use super::super::splat::{GROUP, Splat};
use super::super::tiles::TILE;
pub(super) use super::lanes::{Aligned, LANES, Lanes, SIDE};
use super::pixels::{Columns, Pixels};
use crate::settings::RasterizeArgs;

/// How many: so many that what is kept of each fits the first-level cache, and few enough for eight
/// bits.
pub(super) const BATCH: usize = 128;

/// Sums per splat that its shape and opacity need.
pub(super) const MOMENTS: usize = 6;

/// Sums of the absolute gradients of a splat's screen mean, where they are asked for.
pub(super) const ABSOLUTE: usize = 2;

/// Sums per splat before those of its D colours: the moments, and then the absolute gradients if
/// they are asked for.
pub(super) const fn shape_sums(absolute: bool) -> usize {
    MOMENTS + if absolute { ABSOLUTE } else { 0 }
}

/// Blocks in each row and each column of a tile.
pub(super) const ACROSS: usize = TILE / SIDE;

/// Blocks of a tile, row by row. As many as there are bits in [`Splat::blocks`].
pub(super) const BLOCKS: usize = ACROSS * ACROSS;

impl<T: Real> Splat<T> {
    /// The blocks of the tile that the ellipse reaches, a bit for each: in each row of blocks those
    /// from where it lies farthest left to where it lies farthest right.
    #[inline(always)]
    pub(super) fn blocks(&self, [left, top]: [T; 2]) -> u16 {
        // From its middle to the first and the last pixel of a block; a thousandth of a pixel
        // stands for rounding.
        let (to_pixel, slack) = (T::of((SIDE - 1) as f64 / 2.0), T::of(1e-3));
        let (corner, side) = (self.mean[0] - left, T::of(1.0 / SIDE as f64));
        // In each row of blocks the first, and then the one after the last, each as a power of two:
        // their difference is a run of bits.
        let mut ends = [0i32; 2 * ACROSS];
        for i in 0..2 * ACROSS {
            let sign = if i < ACROSS { -T::ONE } else { T::ONE };
            let first = T::of((i % ACROSS * SIDE) as f64 + 0.5);
            let last = first + to_pixel + to_pixel;
            let rows = [first, last].map(|row| top + row - self.mean[1]);
            let (end, is_there) = self.farthest(sign, rows);
            let end = corner + end + sign * (slack + to_pixel);
            let end = (end * side).greatest(T::ZERO).least(T::of(ACROSS as f64));
            let end = if is_there { end } else { T::ZERO };
            ends[i] = 1 << (end.nearest() & 7);
        }
        let mut blocks = 0;
        for row in 0..ACROSS {
            blocks |= (ends[row + ACROSS] - ends[row]).max(0) << (ACROSS * row);
        }
        blocks as u16
    }

    /// z1 and z2 at the pixels of a block, in units of [`UNIT`].
    #[inline(always)]
    pub(super) fn z<S: Simd>(&self, centres: &Centres<S, T>) -> (Columns<S, T>, Pixels<S, T>) {
        let [x, y] = self.mean;
        let dx = centres.x.plus(Columns::splat(-x));
        let dy = centres.y.plus(Pixels::splat(-y));
        let z2 =
            Pixels::splat(self.w22).times_plus(dy, dx.times(Columns::splat(self.w21)).pixels());
        (dx.times(Columns::splat(self.w11)), z2)
    }

    /// Raw alphas at the pixels of a block, given the falloffs `2^-|z|^2`.
    #[inline(always)]
    pub(super) fn raw<S: Simd>(&self, falloffs: Pixels<S, T>) -> Pixels<S, T> {
        Pixels::splat(self.opacity).times(falloffs)
    }

    /// Gradients of screen mean, w11, w21, w22, and of the opacity, from a splat's sums of g times
    /// 1, z1, z2, z1^2, z1 z2 and z2^2; see the formulas in `gradient.rs`.
    #[inline(always)]
    pub(super) fn gradients(&self, [one, z1, z2, z11, z12, z22]: [T; MOMENTS]) -> ([T; 5], T) {
        let (unit, square) = (T::of(1.0 / UNIT), T::of(1.0 / (UNIT * UNIT)));
        let Self { w11, w21, w22, .. } = *self;
        let (of_w11, of_w22) = (T::ONE / w11, T::ONE / w22);
        let geometry = [
            -(w11 * z1 + w21 * z2) * square,
            -(w22 * z2) * square,
            z11 * of_w11 * unit,
            z12 * of_w11 * unit,
            (z22 - w21 * of_w11 * z12) * of_w22 * unit,
        ];
        (geometry, -one / self.opacity)
    }
}

impl<T: Real> Splat<T> {
    /// Absolute gradients of the screen mean, from the sums of `|g (w11 z1 + w21 z2)|` and
    /// `|g z2|`.
    #[inline(always)]
    pub(super) fn absolute_gradients(&self, [x, y]: [T; ABSOLUTE]) -> [T; ABSOLUTE] {
        let square = T::of(1.0 / (UNIT * UNIT));
        [x * square, self.w22.abs() * y * square]
    }
}

/// Centres of the pixels of a block.
pub(super) struct Centres<S: Simd, T: Real> {
    x: Columns<S, T>,
    y: Pixels<S, T>,
}

impl<S: Simd, T: Real> Centres<S, T> {
    /// Centres of a block of the tile with this corner.
    #[inline(always)]
    pub(super) fn new(block: usize, [left, top]: [T; 2]) -> Self {
        let from = |corner: T, block: usize| corner + T::of_index((block * SIDE) as i32);
        let within = |pixel: usize| T::of(pixel as f64 + 0.5);
        let x = Columns::load(&core::array::from_fn(|i| within(i % SIDE)));
        let y = Pixels::load(&core::array::from_fn(|i| within(i / SIDE)));
        Self {
            x: x.plus(Columns::splat(from(left, block % ACROSS))),
            y: y.plus(Pixels::splat(from(top, block / ACROSS))),
        }
    }
}

/// The corner of a tile, in pixels.
#[inline(always)]
pub(super) fn corner<T: Real>(tile: [usize; 2]) -> [T; 2] {
    tile.map(|at| T::of((at * TILE) as f64))
}

/// Block and lane of a pixel of a tile.
#[inline(always)]
pub(super) fn in_blocks(column: usize, row: usize) -> [usize; 2] {
    [
        row / SIDE * ACROSS + column / SIDE,
        row % SIDE * SIDE + column % SIDE,
    ]
}

/// The lanes of a row of a block, and no more: a copy of all would be read before it is written.
#[inline(always)]
pub(super) fn row_of<V: Copy>(lanes: &Lanes<V>, row: usize) -> [V; SIDE] {
    let (rows, _) = lanes.as_chunks();
    rows[row]
}

/// The same, to be written.
#[inline(always)]
pub(super) fn row_mut<V>(lanes: &mut Lanes<V>, row: usize) -> &mut [V; SIDE] {
    let (rows, _) = lanes.as_chunks_mut();
    &mut rows[row]
}

/// `|z|^2`. Both passes call it, so both see the same bits.
#[inline(always)]
pub(super) fn square<S: Simd, T: Real>(z1: Columns<S, T>, z2: Pixels<S, T>) -> Pixels<S, T> {
    z2.times_plus(z2, z1.times(z1).pixels())
}

/// The one place that decides what becomes of a (pixel, splat) pair; both passes call it.
#[derive(Clone, Copy)]
pub(super) struct Thresholds<T> {
    pub(super) alpha_min: T,
    alpha_max: T,
    pub(super) transmittance_min: T,
}

impl<T: Real> Thresholds<T> {
    pub(super) fn new(args: &RasterizeArgs) -> Self {
        Self {
            alpha_min: T::of(args.settings.alpha_min),
            alpha_max: T::of(args.settings.alpha_max),
            transmittance_min: T::of(args.settings.transmittance_min),
        }
    }

    /// Alpha where a splat is seen, zero elsewhere: where its raw alpha is below a gate.
    #[inline(always)]
    pub(super) fn share<S: Simd>(&self, raw: Pixels<S, T>, gate: Pixels<S, T>) -> Pixels<S, T> {
        let alpha = raw.least(Pixels::splat(self.alpha_max));
        alpha.where_at_least(raw, gate)
    }

    /// A gradient by the raw alpha where it is passed on: at the cap alpha no longer depends on
    /// anything.
    #[inline(always)]
    pub(super) fn below_cap<S: Simd>(
        &self,
        gradient: Pixels<S, T>,
        raw: Pixels<S, T>,
    ) -> Pixels<S, T> {
        gradient.where_below(raw, Pixels::splat(self.alpha_max))
    }

    #[inline(always)]
    pub(super) fn stops(&self, transmittance_after: T) -> bool {
        transmittance_after < self.transmittance_min
    }
}
