//! A splat as the pixels of a tile see it, and what becomes of a (pixel, splat) pair.

use super::super::intersect::{Footprint, TILE};
use super::super::real::Real;
use super::gradient::MOMENTS;
use crate::settings::RasterizeArgs;

/// Pixels that are worked on at once, a block: half a row of a tile, wherever it begins.
pub(super) const LANES: usize = TILE / 2;

/// One value per pixel of a block.
pub(super) type Lanes<T> = [T; LANES];

/// Memory for the pixels of a tile, and so much more that a block may begin at any number of eight bits: no index needs a
/// check.
pub(super) const PLANE: usize = TILE * TILE + LANES;

/// So many splats before its turn a splat is fetched: it lies anywhere in memory.
pub(super) const AHEAD: usize = 4;

/// The inverse Cholesky factor times this, squared, counts in powers of two: `2^-|z|^2 = exp(-sigma)`.
/// `sqrt(log2(e) / 2)`.
const UNIT: f64 = 0.849_321_800_288_019_1;

/// What the inner loops need of a splat.
#[derive(Debug, Clone, Copy)]
pub(super) struct Splat<T> {
    pub(super) mean: [T; 2],
    /// [`UNIT`] times the inverse Cholesky factor.
    w11: T,
    w21: T,
    w22: T,
    pub(super) opacity: T,
    /// The pixel rows that the ellipse reaches, with a pixel of slack.
    rows: [T; 2],
    /// `sigma <= cut` along a row at dy is `|dx - slope dy| <= sqrt(reach - shrink dy^2) inverse_a`.
    slope: T,
    reach: T,
    shrink: T,
    inverse_a: T,
}

impl<T: Real> Splat<T> {
    pub(super) fn new(footprint: &Footprint<T>) -> Self {
        let unit = T::of(UNIT);
        let Footprint { mean, half, .. } = *footprint;
        Self {
            mean,
            w11: footprint.w11 * unit,
            w21: footprint.w21 * unit,
            w22: footprint.w22 * unit,
            opacity: footprint.opacity,
            rows: [mean[1] - half[1] - T::ONE, mean[1] + half[1] + T::ONE],
            slope: footprint.slope,
            reach: footprint.reach,
            shrink: footprint.shrink,
            inverse_a: footprint.inverse_a,
        }
    }

    /// Rows of the tile that the ellipse reaches.
    #[inline(always)]
    pub(super) fn rows(&self, tile: &Centres<T>) -> core::ops::Range<usize> {
        let (top, side) = (tile.ys[0], T::of(TILE as f64));
        let row = |y: T| (y - top).greatest(T::ZERO).least(side).nearest() as usize;
        row(self.rows[0])..TILE.min(row(self.rows[1]))
    }

    /// The columns that the ellipse reaches in each row of the tile.
    #[inline(always)]
    pub(super) fn spans(&self, tile: &Centres<T>) -> Window {
        // A thousandth of a pixel stands for rounding.
        let (slack, half_pixel, side) = (T::of(1e-3), T::of(0.5), T::of(TILE as f64));
        let left = self.mean[0] - tile.xs[0] + half_pixel;
        let mut spans = Window::CLOSED;
        for row in 0..TILE {
            let dy = tile.ys[row] - self.mean[1];
            let discriminant = self.reach - self.shrink * dy * dy;
            let middle = left + self.slope * dy;
            let half = discriminant.greatest(T::ZERO).sqrt() * self.inverse_a + slack;
            // From the first column that is not left of the span to the first that is right of it.
            let from = (middle - half).greatest(T::ZERO).least(side);
            let to = (middle + half).greatest(T::ZERO).least(side);
            let to = if discriminant >= T::ZERO { to } else { T::ZERO };
            spans.from[row] = from.nearest();
            spans.to[row] = to.nearest();
        }
        spans
    }

    /// (z1, z2, exp(-sigma)) at dx from the mean, z in units of [`UNIT`], `w22_dy` being that of
    /// [`along_y`](Self::along_y). Both passes call it, so both see the same bits.
    #[inline(always)]
    pub(super) fn falloff<const FMA: bool>(&self, dx: T, w22_dy: T) -> (T, T, T) {
        let z1 = self.w11 * dx;
        let z2 = T::multiply_add::<FMA>(self.w21, dx, w22_dy);
        (
            z1,
            z2,
            T::exp2_neg::<FMA>(T::multiply_add::<FMA>(z1, z1, z2 * z2)),
        )
    }

    /// What all pixels of a row have in common, dy from the mean.
    #[inline(always)]
    pub(super) fn along_y(&self, dy: T) -> T {
        self.w22 * dy
    }

    /// Gradients of screen mean, w11, w21, w22, and of the opacity, from a splat's sums of g times 1, z1, z2, z1^2, z1 z2
    /// and z2^2; see the formulas in `gradient.rs`.
    #[inline(always)]
    pub(super) fn gradients(&self, [one, z1, z2, z11, z12, z22]: [T; MOMENTS]) -> ([T; 5], T) {
        let (unit, square) = (T::of(UNIT), T::of(UNIT * UNIT));
        let Self { w11, w21, w22, .. } = *self;
        let geometry = [
            -(w11 * z1 + w21 * z2) / square,
            -(w22 * z2) / square,
            z11 / (w11 * unit),
            z12 / (w11 * unit),
            (z22 - w21 / w11 * z12) / (w22 * unit),
        ];
        (geometry, -one / self.opacity)
    }
}

/// A half-open interval of columns for each row of a tile; empty where `from` is not less than `to`.
#[derive(Clone, Copy)]
pub(super) struct Window {
    pub(super) from: [i32; TILE],
    pub(super) to: [i32; TILE],
}

impl Window {
    pub(super) const CLOSED: Self = Self {
        from: [0; TILE],
        to: [0; TILE],
    };
}

/// The values of the block that begins `at` a pixel.
#[inline(always)]
pub(super) fn block<V>(values: &[V; PLANE], at: u8) -> &Lanes<V> {
    let values = &values[usize::from(at)..];
    values.first_chunk().expect("a block is left")
}

/// As [`block`].
#[inline(always)]
pub(super) fn block_mut<V>(values: &mut [V; PLANE], at: u8) -> &mut Lanes<V> {
    let values = &mut values[usize::from(at)..];
    values.first_chunk_mut().expect("a block is left")
}

/// Centres of the pixels of a tile.
pub(super) struct Centres<T> {
    /// Of more than there are, so that a block may begin at any.
    xs: [T; TILE + LANES],
    ys: [T; TILE],
}

impl<T: Real> Centres<T> {
    #[inline(always)]
    pub(super) fn new([tx, ty]: [usize; 2]) -> Self {
        let along = |tile: usize, i: usize| T::of((tile * TILE + i) as f64 + 0.5);
        Self {
            xs: core::array::from_fn(|i| along(tx, i)),
            ys: core::array::from_fn(|i| along(ty, i)),
        }
    }

    /// From a splat's mean to the pixels of the block that begins `at` one: along x of each, along y of all.
    #[inline(always)]
    pub(super) fn from(&self, mean: [T; 2], at: u8) -> (Lanes<T>, T) {
        let at = usize::from(at);
        let xs = &self.xs[at % TILE..][..LANES];
        let dx = core::array::from_fn(|i| xs[i] - mean[0]);
        (dx, self.ys[at / TILE] - mean[1])
    }
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
}
