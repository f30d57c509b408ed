//! The two precisions of the CPU path.

use core::fmt::Debug;
use core::iter::Sum;
use core::ops::{Add, AddAssign, Div, Mul, Neg, Sub, SubAssign};

use burn::tensor::Element;

use super::buffer::Overwritten;

/// f32 or f64. Only what the ops need; every method is inlined so that loops over lanes vectorise.
pub(crate) trait Real:
    Element
    + Overwritten
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
    /// What [`key`](Self::key) makes.
    type Key: Ord + Copy + Send + Sync;

    /// An integer that sorts as the number does (negative ones too).
    fn key(self) -> Self::Key;
    /// The nearest integer, ties to even, of a number from 0 to a million.
    fn nearest(self) -> i32;
    /// The nearest value of this precision.
    fn of(value: f64) -> Self;
    /// Widened, or unchanged.
    fn wide(self) -> f64;
    fn sqrt(self) -> Self;
    fn ln(self) -> Self;
    fn abs(self) -> Self;
    fn is_finite(self) -> bool;
    /// `a b + c`, in one rounding where `FMA` says that this is one instruction.
    fn multiply_add<const FMA: bool>(a: Self, b: Self, c: Self) -> Self;
    /// `2^-t` for `t >= 0`; anything under 1e-30 may come out as any such value. `FMA`: with fused
    /// products and sums, for code that is compiled for a processor which has them.
    fn exp2_neg<const FMA: bool>(t: Self) -> Self;

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
    type Key = i64;

    #[inline(always)]
    fn key(self) -> i64 {
        let bits = self.to_bits() as i64;
        bits ^ (((bits >> 63) as u64) >> 1) as i64
    }
    #[inline(always)]
    fn nearest(self) -> i32 {
        self.round_ties_even() as i32
    }

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
    fn multiply_add<const FMA: bool>(a: Self, b: Self, c: Self) -> Self {
        if FMA { a.mul_add(b, c) } else { a * b + c }
    }
    #[inline(always)]
    fn exp2_neg<const FMA: bool>(t: Self) -> Self {
        (-t).exp2()
    }
}

impl Real for f32 {
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;
    type Key = i32;

    #[inline(always)]
    fn key(self) -> i32 {
        let bits = self.to_bits() as i32;
        bits ^ (((bits >> 31) as u32) >> 1) as i32
    }
    #[inline(always)]
    fn nearest(self) -> i32 {
        // Casts saturate, which takes a branch.
        ((self + ROUND).to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32)
    }

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
    fn multiply_add<const FMA: bool>(a: Self, b: Self, c: Self) -> Self {
        if FMA { a.mul_add(b, c) } else { a * b + c }
    }
    #[inline(always)]
    fn exp2_neg<const FMA: bool>(t: Self) -> Self {
        exp2_neg_f32::<FMA>(t)
    }
}

/// 1.5 * 2^23: adding it rounds to the nearest integer and leaves that integer in the low bits.
const ROUND: f32 = 12_582_912.0;

/// Coefficients from degree 5 down. They are those of the kernels too (`splat_kernels::exp`): the
/// polynomial with p(0) = 1 whose largest relative error from `2^-g` on `|g| <= 1/2` is least, 1.1e-7.
const EXP2: [f32; 6] = [
    -0.001_326_472_7,
    0.009_671_513,
    -0.055_507_336,
    0.240_222_42,
    -0.693_146_94,
    1.0,
];

/// `2^-t` as `2^n 2^-g` with `|g| <= 1/2`: g is exact, and a polynomial stands for `2^-g`. No branch and no library call,
/// so that loops over it vectorise. Against f64 on [0, 24]: relative error below 2e-7 (see the test), fused or not.
#[inline(always)]
fn exp2_neg_f32<const FMA: bool>(t: f32) -> f32 {
    let t = t.least(115.0);
    let shifted = ROUND - t;
    let g = t + (shifted - ROUND);
    let mut p = EXP2[0];
    for coefficient in &EXP2[1..] {
        p = f32::multiply_add::<FMA>(p, g, *coefficient);
    }
    // The low bits of `shifted` are n; added to the exponent they multiply by 2^n.
    f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
}

#[cfg(test)]
mod tests {
    use super::Real;

    fn check<const FMA: bool>() {
        let mut worst = 0.0f64;
        for i in 0..=2_400_000 {
            let t = i as f32 * 1e-5;
            let exact = (-f64::from(t)).exp2();
            worst = worst.max((f64::from(f32::exp2_neg::<FMA>(t)) / exact - 1.0).abs());
        }
        println!("fused: {FMA}, worst relative error {worst:e}");
        assert!(worst < 2e-7, "worst relative error {worst:e}");
        assert!(f32::exp2_neg::<FMA>(1e9) < 1e-30);
        assert!(f32::exp2_neg::<FMA>(f32::NAN) < 1e-30);
        assert_eq!(f32::exp2_neg::<FMA>(0.0), 1.0);
    }

    #[test]
    fn exp_is_exact_to_two_ulp_on_the_range_of_visible_splats() {
        check::<true>();
        check::<false>();
    }
}
