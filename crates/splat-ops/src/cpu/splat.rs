//! A splat in the form of the inner loops: its ellipse, and the numbers for its alpha at a pixel.

use super::overwritten::Overwritten;
use super::real::Real;

/// Factor of the inverse Cholesky factor that makes exponents powers of two: `2^-|z|^2 =
/// exp(-sigma)`. `sqrt(log2(e) / 2)`.
pub(super) const UNIT: f64 = 0.849_321_800_288_019_1;

/// Numbers of a splat besides its colour.
pub(super) const NUMBERS: usize = 11;

/// Channels processed at once.
pub(super) const GROUP: usize = 4;

/// A splat in the form of the inner loops, in one cache line if in single precision. Its ellipse is
/// the region that can pass the `alpha_min` test: `sigma <= cut` with cut = `ln(opacity /
/// alpha_min)`, widened slightly so that rounding never drops a pixel.
#[derive(Debug, Clone, Copy, Default)]
#[repr(align(64))]
pub(super) struct Splat<T> {
    pub(super) mean: [T; 2],
    /// [`UNIT`] times the inverse Cholesky factor.
    pub(super) w11: T,
    pub(super) w21: T,
    pub(super) w22: T,
    pub(super) opacity: T,
    /// Along a row at dy, the ellipse is `|dx - slope dy| <= sqrt(reach - shrink dy^2) inverse_a`.
    slope: T,
    reach: T,
    shrink: T,
    inverse_a: T,
    /// The dy of the ellipse's right end; the left end is opposite.
    end: T,
    /// First channels of the colour; zero if there are fewer.
    pub(super) color: [T; GROUP],
}

impl<T: Overwritten> Overwritten for Splat<T> {
    const CLEAR: Self = Self::of_one(T::CLEAR);
    #[cfg(test)]
    const POISON: Self = Self::of_one(T::POISON);
}

impl<T: Copy> Splat<T> {
    const fn of_one(number: T) -> Self {
        Self::from_numbers([number; NUMBERS], [number; GROUP])
    }

    #[inline(always)]
    pub(super) const fn from_numbers(
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
        color: [T; GROUP],
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
            color,
        }
    }

    /// Everything except the colour.
    #[inline(always)]
    pub(super) fn into_numbers(self) -> [T; NUMBERS] {
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
            ..
        } = self;
        [
            x, y, w11, w21, w22, opacity, slope, reach, shrink, inverse_a, end,
        ]
    }
}

impl<T: Real> Splat<T> {
    /// Builds a splat without a colour, and half the height of its ellipse, from screen mean,
    /// inverse Cholesky factor and opacity.
    #[inline(always)]
    pub(super) fn new([x, y, w11, w21, w22, opacity]: [T; 6], alpha_min: T) -> (Self, T) {
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
            color: [T::ZERO; GROUP],
        };
        (splat, radius * a.sqrt() / (w11 * w22))
    }

    /// How far right (left with a sign of -1) the ellipse extends between two rows, and whether it
    /// reaches them. Relative to the mean.
    #[inline(always)]
    pub(super) fn farthest(&self, sign: T, [first, last]: [T; 2]) -> (T, bool) {
        let dy = (sign * self.end).greatest(first).least(last);
        let discriminant = self.reach - self.shrink * dy * dy;
        let half = discriminant.greatest(T::ZERO).sqrt() * self.inverse_a;
        (self.slope * dy + sign * half, discriminant >= T::ZERO)
    }
}
