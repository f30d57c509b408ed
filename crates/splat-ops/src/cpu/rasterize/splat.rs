//! A splat as the pixels of a tile see it, and what becomes of a (pixel, splat) pair.

use super::super::intersect::{Footprint, TILE};
use super::super::real::Real;
use crate::settings::RasterizeArgs;

/// Pixels that are worked on at once: half a row of a tile.
pub(super) const LANES: usize = 8;
/// Blocks of [`LANES`] pixels in a row of a tile.
pub(super) const HALVES: usize = TILE / LANES;
/// Blocks of a tile, row by row.
pub(super) const BLOCKS: usize = TILE * HALVES;

/// One value per pixel of a block.
pub(super) type Lanes<T> = [T; LANES];

/// What the inner loops need of a splat, computed once per view.
#[derive(Clone, Copy)]
pub(super) struct Splat<T> {
    pub(super) mean: [T; 2],
    pub(super) w11: T,
    pub(super) w21: T,
    pub(super) w22: T,
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
    /// `None` for a splat that is seen nowhere, as [`Footprint::new`] has it.
    pub(super) fn new(packed: &[T], opacity: T, args: &RasterizeArgs) -> Option<Self> {
        let Footprint {
            mean,
            w11,
            w21,
            w22,
            cut,
            half,
        } = Footprint::new(packed, opacity, args)?;
        let a = w11 * w11 + w21 * w21;
        let inverse_a = T::ONE / a;
        Some(Self {
            mean,
            w11,
            w21,
            w22,
            opacity,
            rows: [mean[1] - half[1] - T::ONE, mean[1] + half[1] + T::ONE],
            slope: -w21 * w22 * inverse_a,
            reach: (cut + cut) * a,
            shrink: w11 * w22 * w11 * w22,
            inverse_a,
        })
    }

    /// Rows of the tile beginning at pixel row `y0` that the ellipse reaches.
    #[inline(always)]
    pub(super) fn rows(&self, y0: usize) -> core::ops::Range<usize> {
        let row = |y: T| ((y.wide() - y0 as f64).max(0.0) as usize).min(TILE);
        row(self.rows[0])..row(self.rows[1])
    }

    /// Per row of a tile, the columns that the ellipse reaches, as x of pixel centres from and to;
    /// an empty interval where it reaches none.
    #[inline(always)]
    pub(super) fn spans(&self, centres: &[T; TILE]) -> ([T; TILE], [T; TILE]) {
        // A thousandth of a pixel stands for rounding.
        let (slack, none) = (T::of(1e-3), T::of(-1e30));
        let (mut from, mut to) = ([T::ZERO; TILE], [T::ZERO; TILE]);
        for row in 0..TILE {
            let dy = centres[row] - self.mean[1];
            let discriminant = self.reach - self.shrink * dy * dy;
            let middle = self.mean[0] + self.slope * dy;
            let half = discriminant.greatest(T::ZERO).sqrt() * self.inverse_a + slack;
            from[row] = middle - half;
            to[row] = if discriminant >= T::ZERO {
                middle + half
            } else {
                none
            };
        }
        (from, to)
    }

    /// (z1, z2, exp(-sigma)) at dx from the mean, `w22_dy` being w22 dy. Both passes call it, so both see
    /// the same bits.
    #[inline(always)]
    pub(super) fn falloff<const FMA: bool>(&self, dx: T, w22_dy: T) -> (T, T, T) {
        let z1 = self.w11 * dx;
        let z2 = T::multiply_add::<FMA>(self.w21, dx, w22_dy);
        let sigma = T::of(0.5) * T::multiply_add::<FMA>(z1, z1, z2 * z2);
        (z1, z2, T::exp_neg::<FMA>(sigma))
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

/// Centres of the sixteen pixels from `first` on, along one axis.
#[inline(always)]
pub(super) fn pixel_centres<T: Real>(first: usize) -> [T; TILE] {
    core::array::from_fn(|i| T::of((first + i) as f64 + 0.5))
}

/// The half of a row's values that belongs to a block.
#[inline(always)]
pub(super) fn half_of<T: Real>(row: &[T; TILE], half: usize) -> Lanes<T> {
    core::array::from_fn(|i| row[half * LANES + i])
}
