//! The two precisions of the CPU path.

use core::fmt::Debug;
use core::iter::Sum;
use core::ops::{Add, AddAssign, Div, Mul, Neg, Sub, SubAssign};

use burn::tensor::Element;

/// f32 or f64. Only what the ops need; every method is inlined so that loops over lanes vectorise.
pub(super) trait Real:
    Element
    + bytemuck::Pod
    + Copy
    + Debug
    + Default
    + PartialOrd
    + Send
    + Sync
    + Sum
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
{
    const ZERO: Self;
    const ONE: Self;

    /// The nearest value of this precision.
    fn of(value: f64) -> Self;
    /// Widened, or unchanged.
    fn wide(self) -> f64;
    fn sqrt(self) -> Self;
    fn ln(self) -> Self;
    fn abs(self) -> Self;
    fn is_finite(self) -> bool;
    /// `exp(-sigma)` for `sigma >= 0`; anything under 1e-30 may come out as any such value.
    fn exp_neg(sigma: Self) -> Self;

    /// The lesser one; the second if the first is NaN.
    #[inline(always)]
    fn least(self, other: Self) -> Self {
        if self < other { self } else { other }
    }

    /// The greater one; the second if the first is NaN.
    #[inline(always)]
    fn greatest(self, other: Self) -> Self {
        if self > other { self } else { other }
    }
}

impl Real for f64 {
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;

    fn of(value: f64) -> Self {
        value
    }
    fn wide(self) -> f64 {
        self
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        self.sqrt()
    }
    fn ln(self) -> Self {
        self.ln()
    }
    #[inline(always)]
    fn abs(self) -> Self {
        self.abs()
    }
    fn is_finite(self) -> bool {
        self.is_finite()
    }
    #[inline(always)]
    fn exp_neg(sigma: Self) -> Self {
        (-sigma).exp()
    }
}

impl Real for f32 {
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;

    #[inline(always)]
    fn of(value: f64) -> Self {
        value as f32
    }
    fn wide(self) -> f64 {
        self as f64
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        self.sqrt()
    }
    fn ln(self) -> Self {
        self.ln()
    }
    #[inline(always)]
    fn abs(self) -> Self {
        self.abs()
    }
    fn is_finite(self) -> bool {
        self.is_finite()
    }
    #[inline(always)]
    fn exp_neg(sigma: Self) -> Self {
        exp_neg_f32(sigma)
    }
}

/// `exp(-sigma)` by range reduction, `2^n e^r` with `|r| <= ln(2) / 2`, and the Taylor polynomial
/// of degree 7 for `e^r` (5e-9 from it). No branch and no library call, so that loops over it
/// vectorise. Against f64 on [0, 16]: relative error below 2e-7, a rounding or two (see the test).
#[inline(always)]
fn exp_neg_f32(sigma: f32) -> f32 {
    // 1.5 * 2^23: adding it rounds to the nearest integer and leaves that integer in the low bits.
    const ROUND: f32 = 12_582_912.0;
    // ln(2) in two parts; the first has so few bits that n * LN2_HIGH is exact.
    const LN2_HIGH: f32 = 0.693_359_4;
    const LN2_LOW: f32 = -2.121_944_4e-4;

    let x = -(sigma.least(80.0));
    let shifted = x * core::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = (x - n * LN2_HIGH) - n * LN2_LOW;
    let mut p = 1.0 / 5040.0;
    p = p * r + 1.0 / 720.0;
    p = p * r + 1.0 / 120.0;
    p = p * r + 1.0 / 24.0;
    p = p * r + 1.0 / 6.0;
    p = p * r + 0.5;
    p = p * r + 1.0;
    p = p * r + 1.0;
    // The low bits of `shifted` are n; moved into the exponent they make 2^n.
    let two_to_n = f32::from_bits((shifted.to_bits() << 23).wrapping_add(1.0f32.to_bits()));
    p * two_to_n
}

#[cfg(test)]
mod tests {
    use super::exp_neg_f32;

    #[test]
    fn exp_is_exact_to_two_ulp_on_the_range_of_visible_splats() {
        let mut worst = 0.0f64;
        for i in 0..=1_600_000 {
            let sigma = i as f32 * 1e-5;
            let exact = (-(sigma as f64)).exp();
            worst = worst.max((exp_neg_f32(sigma) as f64 / exact - 1.0).abs());
        }
        assert!(worst < 2e-7, "worst relative error {worst:e}");
        assert!(exp_neg_f32(1e9) < 1e-30);
        assert_eq!(exp_neg_f32(0.0), 1.0);
    }
}
