//! A splat as the pixels of a tile see it, and what becomes of a (pixel, splat) pair.

use super::super::buffer::Overwritten;
use super::super::intersect::TILE;
use super::super::real::Real;
use super::gradient::MOMENTS;
use crate::settings::RasterizeArgs;

/// Side of a block, the pixels that are worked on at once: as long as it is wide, since then fewest pixels are tested that
/// a splat does not reach, whatever way it lies.
pub(super) const SIDE: usize = 4;

/// Pixels of a block, row by row.
pub(super) const LANES: usize = SIDE * SIDE;

/// Blocks in each row and each column of a tile.
pub(super) const ACROSS: usize = TILE / SIDE;

/// Blocks of a tile, row by row. As many as there are bits in [`Splat::blocks`].
pub(super) const BLOCKS: usize = ACROSS * ACROSS;

/// One value per pixel of a block.
pub(super) type Lanes<T> = [T; LANES];

/// Half of a block's pixels, its upper or its lower rows: both lie in the same columns, and need some things only once.
pub(super) const HALF: usize = LANES / 2;

/// One value per pixel of half a block.
pub(super) type Half<T> = [T; HALF];

/// As wide registers want it in memory: what lies across two lines of the cache is read and written twice as slowly.
#[derive(Debug, Clone, Copy)]
#[repr(align(32))]
pub(super) struct Aligned<V>(pub(super) V);

/// So many splats before its turn a splat is fetched: it lies anywhere in memory.
pub(super) const AHEAD: usize = 12;

/// The inverse Cholesky factor times this, squared, counts in powers of two: `2^-|z|^2 = exp(-sigma)`.
/// `sqrt(log2(e) / 2)`.
const UNIT: f64 = 0.849_321_800_288_019_1;

/// How many numbers a splat has.
pub(in crate::cpu) const NUMBERS: usize = 11;

/// What the inner loops need of a splat. Its ellipse is the part of it that can pass the `alpha_min` test: `sigma <= cut`,
/// cut being `ln(opacity / alpha_min)`, widened by a little so that rounding never drops a pixel.
#[derive(Debug, Clone, Copy, Default)]
pub(in crate::cpu) struct Splat<T> {
    pub(in crate::cpu) mean: [T; 2],
    /// [`UNIT`] times the inverse Cholesky factor.
    w11: T,
    w21: T,
    w22: T,
    opacity: T,
    /// Along a row at dy the ellipse is `|dx - slope dy| <= sqrt(reach - shrink dy^2) inverse_a`.
    slope: T,
    reach: T,
    shrink: T,
    inverse_a: T,
    /// The dy of the ellipse's right end; its left one lies opposite.
    end: T,
}

impl<T: Overwritten> Overwritten for Splat<T> {
    const CLEAR: Self = Self::of_one(T::CLEAR);
    #[cfg(test)]
    const POISON: Self = Self::of_one(T::POISON);
}

impl<T: Copy> Splat<T> {
    const fn of_one(number: T) -> Self {
        Self::from_numbers([number; NUMBERS])
    }

    #[inline(always)]
    pub(in crate::cpu) const fn from_numbers(
        [
            x,
            y,
            w11,
            w21,
            w22,
            opacity,
            slope,
            reach,
            shrink,
            inverse_a,
            end,
        ]: [T; NUMBERS],
    ) -> Self {
        Self {
            mean: [x, y],
            w11,
            w21,
            w22,
            opacity,
            slope,
            reach,
            shrink,
            inverse_a,
            end,
        }
    }

    #[inline(always)]
    pub(in crate::cpu) fn into_numbers(self) -> [T; NUMBERS] {
        let Self {
            mean: [x, y],
            w11,
            w21,
            w22,
            opacity,
            slope,
            reach,
            shrink,
            inverse_a,
            end,
        } = self;
        [
            x, y, w11, w21, w22, opacity, slope, reach, shrink, inverse_a, end,
        ]
    }
}

impl<T: Real> Splat<T> {
    /// From screen mean, inverse Cholesky factor and opacity; and half the height of its ellipse.
    #[inline(always)]
    pub(in crate::cpu) fn new([x, y, w11, w21, w22, opacity]: [T; 6], alpha_min: T) -> (Self, T) {
        let cut = (opacity / alpha_min).ln();
        let cut = cut + T::of(1e-4) * (cut + T::ONE);
        // L = W^-1 has l11 = 1/w11, l21 = -w21/(w11 w22), l22 = 1/w22; covariance = L L^T.
        let (radius, a) = ((cut + cut).sqrt(), w11 * w11 + w21 * w21);
        let unit = T::of(UNIT);
        let splat = Self {
            mean: [x, y],
            w11: w11 * unit,
            w21: w21 * unit,
            w22: w22 * unit,
            opacity,
            slope: -w21 * w22 / a,
            reach: (cut + cut) * a,
            shrink: w11 * w22 * w11 * w22,
            inverse_a: T::ONE / a,
            // Where z2 = 0.
            end: -w21 / w22 * (radius / w11),
        };
        (splat, radius * a.sqrt() / (w11 * w22))
    }

    /// Where between two rows the ellipse lies farthest right, or with a sign of -1 left, and whether it lies there at
    /// all. All seen from its mean.
    #[inline(always)]
    pub(in crate::cpu) fn farthest(&self, sign: T, [first, last]: [T; 2]) -> (T, bool) {
        let dy = (sign * self.end).greatest(first).least(last);
        let discriminant = self.reach - self.shrink * dy * dy;
        let half = discriminant.greatest(T::ZERO).sqrt() * self.inverse_a;
        (self.slope * dy + sign * half, discriminant >= T::ZERO)
    }

    /// The blocks of the tile that the ellipse reaches, a bit for each: in each row of blocks those from where it lies
    /// farthest left to where it lies farthest right.
    #[inline(always)]
    pub(super) fn blocks(&self, [left, top]: [T; 2]) -> u16 {
        // From its middle to the first and the last pixel of a block; a thousandth of a pixel stands for rounding.
        let (to_pixel, slack) = (T::of((SIDE - 1) as f64 / 2.0), T::of(1e-3));
        let (corner, side) = (self.mean[0] - left, T::of(1.0 / SIDE as f64));
        // In each row of blocks the first, and then the one after the last, each as a power of two: their difference
        // is a run of bits.
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

    /// z1 in a column of pixels, and z2 at two pixels of it, in units of [`UNIT`].
    #[inline(always)]
    pub(super) fn z<const FMA: bool>(&self, x: T, [upper, lower]: [T; 2]) -> (T, [T; 2]) {
        let dx = x - self.mean[0];
        let z2_of_dx = self.w21 * dx;
        let z2 = |y: T| T::multiply_add::<FMA>(self.w22, y - self.mean[1], z2_of_dx);
        (self.w11 * dx, [z2(upper), z2(lower)])
    }

    /// Raw alphas at the pixels of a block, given the falloffs `2^-|z|^2`.
    #[inline(always)]
    pub(super) fn raw(&self, falloffs: &Lanes<T>) -> Lanes<T> {
        let mut raw = *falloffs;
        for i in 0..LANES {
            raw[i] = self.opacity * falloffs[i];
        }
        raw
    }

    /// Gradients of screen mean, w11, w21, w22, and of the opacity, from a splat's sums of g times 1, z1, z2, z1^2, z1 z2
    /// and z2^2; see the formulas in `gradient.rs`.
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

/// Centres of the pixels of a block.
#[derive(Clone, Copy)]
pub(super) struct Centres<T> {
    /// Of the upper and of the lower half.
    pub(super) x: Half<T>,
    pub(super) y: [Half<T>; 2],
}

impl<T: Real> Centres<T> {
    /// Of each block of a tile, seen from its corner. To be kept in memory: if the compiler knew which of them are the
    /// same, it would work on quarters and shuffle the results into place.
    pub(super) fn of_blocks() -> [Self; BLOCKS] {
        core::array::from_fn(|block| {
            let along = |pixel: usize| T::of(pixel as f64 + 0.5);
            let (column, row) = (block % ACROSS * SIDE, block / ACROSS * SIDE);
            let rows = |first| core::array::from_fn(|i| along(row + (first + i) / SIDE));
            Self {
                x: core::array::from_fn(|i| along(column + i % SIDE)),
                y: [rows(0), rows(HALF)],
            }
        })
    }

    /// From the corner of the image.
    #[inline(always)]
    pub(super) fn beyond(self, [left, top]: [T; 2]) -> Self {
        let Self { mut x, mut y } = self;
        for i in 0..HALF {
            x[i] += left;
            y[0][i] += top;
            y[1][i] += top;
        }
        Self { x, y }
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

/// `|z|^2` of two pixels of a column. Both passes call it, so both see the same bits.
#[inline(always)]
pub(super) fn squares<T: Real, const FMA: bool>(z1: T, [upper, lower]: [T; 2]) -> [T; 2] {
    let of_z1 = z1 * z1;
    [
        T::multiply_add::<FMA>(upper, upper, of_z1),
        T::multiply_add::<FMA>(lower, lower, of_z1),
    ]
}

/// Whether any lane is less than a bound.
#[inline(always)]
pub(super) fn any_less<T: Real>(lanes: &Lanes<T>, bound: T) -> bool {
    // The lesser ones of both halves, which leaves one register to look at.
    let mut least = [T::ZERO; HALF];
    for i in 0..HALF {
        least[i] = lanes[i].least(lanes[i + HALF]);
    }
    least
        .iter()
        .fold(false, |any, least| any | (*least < bound))
}

/// The one place that decides what becomes of a (pixel, splat) pair; both passes call it.
#[derive(Clone, Copy)]
pub(super) struct Thresholds<T> {
    pub(super) alpha_min: T,
    alpha_max: T,
    transmittance_min: T,
}

impl<T: Real> Thresholds<T> {
    pub(super) fn new(args: &RasterizeArgs) -> Self {
        Self {
            alpha_min: T::of(args.settings.alpha_min),
            alpha_max: T::of(args.settings.alpha_max),
            transmittance_min: T::of(args.settings.transmittance_min),
        }
    }

    #[inline(always)]
    pub(super) fn seen(&self, raw: T) -> bool {
        raw >= self.alpha_min
    }

    #[inline(always)]
    pub(super) fn alpha(&self, raw: T) -> T {
        raw.least(self.alpha_max)
    }

    /// At the cap alpha no longer depends on anything.
    #[inline(always)]
    pub(super) fn capped(&self, raw: T) -> bool {
        raw >= self.alpha_max
    }

    #[inline(always)]
    pub(super) fn stops(&self, transmittance_after: T) -> bool {
        transmittance_after < self.transmittance_min
    }

    /// Whether any pixel of a block does.
    #[inline(always)]
    pub(super) fn any_stops(&self, transmittance_after: &Lanes<T>) -> bool {
        any_less(transmittance_after, self.transmittance_min)
    }
}
