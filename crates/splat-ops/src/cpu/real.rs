//! The two precisions of the CPU path.

use core::fmt::Debug;
use core::iter::Sum;
use core::ops::{Add, AddAssign, Div, Mul, Neg, Sub, SubAssign};

use burn::tensor::Element;
use macerator::{Scalar, Simd, VAdd, VMaskReduce, VMul, VMulAdd, VOrd, VSelect, VSub, Vector};

use splat_core::exp::{
    EXP, EXP_LN2_HIGH, EXP_LN2_LOW, EXP2_NEG as EXP2, ROUND_TO_INTEGER as ROUND,
};

use super::overwritten::Overwritten;

/// f32 or f64, with the operations that the ops need. Every method is inlined, so that loops over
/// lanes vectorise.
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
    + VAdd
    + VSub
    + VMul
    + VMulAdd
    + VOrd
    + VSelect
    + VMaskReduce
{
    const ZERO: Self;
    const ONE: Self;
    /// Type of [`sort_key`](Self::sort_key).
    type SortKey: Ord + Copy + Send + Sync;

    /// Integer key that orders numbers (negative ones too), with ties ordered by `index`.
    fn sort_key(self, index: u32) -> Self::SortKey;
    /// The index in a key.
    fn index_of(key: Self::SortKey) -> u32;
    /// Nearest integer, ties to even, of a number from 0 to a million.
    fn nearest(self) -> i32;
    /// Nearest value of this precision.
    fn of(value: f64) -> Self;
    /// Value in double precision.
    fn wide(self) -> f64;
    /// `level / 255`.
    fn of_level(level: u8) -> Self;
    /// A whole number below 2^24.
    fn of_index(index: i32) -> Self;
    fn sqrt(self) -> Self;
    /// Natural logarithm of a positive normal number, with an absolute or relative error of 3e-7.
    fn ln(self) -> Self;
    fn abs(self) -> Self;
    fn is_finite(self) -> bool;
    /// `a b + c`, rounded once if `FMA` says that this is one instruction.
    fn multiply_add<const FMA: bool>(a: Self, b: Self, c: Self) -> Self;
    /// `2^-t` for `t >= 0`, for several registers; results below 1e-30 are only approximate.
    fn exp2_neg<S: Simd>(t: &mut [Vector<S, Self>]);

    /// `exp(x)`, to 2 units in the last place.
    fn exp<const FMA: bool>(x: Self) -> Self;

    /// Transposes rows to columns.
    #[inline(always)]
    fn transposed(rows: [[Self; 4]; 4]) -> [[Self; 4]; 4] {
        core::array::from_fn(|i| core::array::from_fn(|j| rows[j][i]))
    }

    /// Sums of four pairs.
    #[inline(always)]
    fn sums(a: [Self; 4], b: [Self; 4]) -> [Self; 4] {
        core::array::from_fn(|i| a[i] + b[i])
    }

    /// The smaller one; the second if the first is NaN.
    #[inline(always)]
    fn least(self, other: Self) -> Self {
        if self < other { self } else { other }
    }

    /// The larger one; the second if the first is NaN.
    #[inline(always)]
    fn greatest(self, other: Self) -> Self {
        if self > other { self } else { other }
    }
}

impl Real for f64 {
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;
    type SortKey = i128;

    #[inline(always)]
    fn sort_key(self, index: u32) -> i128 {
        let bits = self.to_bits() as i64;
        let key = bits ^ (((bits >> 63) as u64) >> 1) as i64;
        (i128::from(key) << 32) | i128::from(index)
    }
    #[inline(always)]
    fn index_of(key: i128) -> u32 {
        key as u32
    }
    #[inline(always)]
    fn nearest(self) -> i32 {
        self.round_ties_even() as i32
    }

    #[inline(always)]
    fn of(value: f64) -> Self {
        value
    }
    #[inline(always)]
    fn wide(self) -> f64 {
        self
    }
    #[inline(always)]
    fn of_level(level: u8) -> Self {
        f64::from(level) / 255.0
    }
    #[inline(always)]
    fn of_index(index: i32) -> Self {
        f64::from(index)
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
    #[inline(always)]
    fn is_finite(self) -> bool {
        self.is_finite()
    }
    #[inline(always)]
    fn multiply_add<const FMA: bool>(a: Self, b: Self, c: Self) -> Self {
        if FMA { a.mul_add(b, c) } else { a * b + c }
    }
    #[inline(always)]
    fn exp2_neg<S: Simd>(t: &mut [Vector<S, f64>]) {
        for lane in bytemuck::cast_slice_mut::<_, f64>(t) {
            *lane = (-*lane).exp2();
        }
    }
    #[inline(always)]
    fn exp<const FMA: bool>(x: Self) -> Self {
        x.exp()
    }
}

impl Real for f32 {
    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;
    type SortKey = i64;

    #[inline(always)]
    fn sort_key(self, index: u32) -> i64 {
        let bits = self.to_bits() as i32;
        let key = bits ^ (((bits >> 31) as u32) >> 1) as i32;
        (i64::from(key) << 32) | i64::from(index)
    }
    #[inline(always)]
    fn index_of(key: i64) -> u32 {
        key as u32
    }
    #[inline(always)]
    fn nearest(self) -> i32 {
        // Saturating casts would take a branch.
        ((self + ROUND).to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32)
    }

    #[inline(always)]
    fn of(value: f64) -> Self {
        value as f32
    }
    #[inline(always)]
    fn wide(self) -> f64 {
        self as f64
    }
    #[inline(always)]
    fn of_level(level: u8) -> Self {
        f32::from(level) / 255.0
    }
    #[inline(always)]
    fn of_index(index: i32) -> Self {
        index as f32
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        self.sqrt()
    }
    #[inline(always)]
    fn ln(self) -> Self {
        ln_f32(self)
    }
    #[inline(always)]
    fn abs(self) -> Self {
        self.abs()
    }
    #[inline(always)]
    fn is_finite(self) -> bool {
        self.is_finite()
    }
    #[inline(always)]
    fn multiply_add<const FMA: bool>(a: Self, b: Self, c: Self) -> Self {
        if FMA { a.mul_add(b, c) } else { a * b + c }
    }
    #[inline(always)]
    fn exp2_neg<S: Simd>(t: &mut [Vector<S, f32>]) {
        exp2_neg_f32(t);
    }
    // The compiler would turn the loop into sixteen moves.
    #[cfg(target_arch = "x86_64")]
    #[inline(always)]
    fn transposed(rows: [[f32; 4]; 4]) -> [[f32; 4]; 4] {
        use core::arch::x86_64::{_mm_movehl_ps, _mm_movelh_ps, _mm_unpackhi_ps, _mm_unpacklo_ps};
        let [a, b, c, d] = bytemuck::cast(rows);
        // SAFETY: every 64-bit x86 processor supports these instructions.
        let columns = unsafe {
            let (low, high) = (_mm_unpacklo_ps(a, b), _mm_unpackhi_ps(a, b));
            let (low_cd, high_cd) = (_mm_unpacklo_ps(c, d), _mm_unpackhi_ps(c, d));
            [
                _mm_movelh_ps(low, low_cd),
                _mm_movehl_ps(low_cd, low),
                _mm_movelh_ps(high, high_cd),
                _mm_movehl_ps(high_cd, high),
            ]
        };
        bytemuck::cast(columns)
    }
    // The compiler would take the four apart and join them again differently.
    #[cfg(target_arch = "x86_64")]
    #[inline(always)]
    fn sums(a: [f32; 4], b: [f32; 4]) -> [f32; 4] {
        use core::arch::x86_64::_mm_add_ps;
        // SAFETY: every 64-bit x86 processor supports the instruction.
        bytemuck::cast(unsafe { _mm_add_ps(bytemuck::cast(a), bytemuck::cast(b)) })
    }
    #[inline(always)]
    fn exp<const FMA: bool>(x: Self) -> Self {
        exp_f32::<FMA>(x)
    }
}

/// `2^-t` as `2^n 2^-g` with `|g| <= 1/2`: g is exact, and a polynomial stands for `2^-g`. Against
/// f64 on [0, 24]: relative error below 2e-7 (see the test), fused or not.
// One step for all registers before the next: each step depends on the one before, and the
// processor looks only so far ahead for independent work.
#[inline(always)]
fn exp2_neg_f32<S: Simd>(t: &mut [Vector<S, f32>]) {
    let zero = 0f32.splat();
    // As many as there can be.
    let (mut shifted, mut g): ([Vector<S, f32>; 16], _) = ([zero; 16], [zero; 16]);
    let mut power: [Vector<S, f32>; 16] = [EXP2[0].splat(); 16];
    let count = t.len();
    for i in 0..count {
        t[i] = t[i].min(115f32.splat());
    }
    for i in 0..count {
        shifted[i] = ROUND.splat() - t[i];
    }
    for i in 0..count {
        g[i] = shifted[i] - ROUND.splat();
    }
    for i in 0..count {
        g[i] = t[i] + g[i];
    }
    for coefficient in &EXP2[1..] {
        for i in 0..count {
            power[i] = power[i].mul_add(g[i], coefficient.splat());
        }
    }
    // The low bits of `shifted` are n; added to the exponent they multiply by 2^n.
    for i in 0..count {
        let n = shifted[i].reinterpret::<u32>() << 23;
        t[i] = (power[i].reinterpret::<u32>() + n).reinterpret();
    }
}

/// Horner's rule; coefficients from the highest degree down.
#[inline(always)]
fn polynomial<const FMA: bool>([c5, rest @ ..]: &[f32; 6], x: f32) -> f32 {
    let mut sum = *c5;
    for coefficient in rest {
        sum = f32::multiply_add::<FMA>(sum, x, *coefficient);
    }
    sum
}

/// `exp(x) = 2^n e^r` for any x: infinity and zero out of range, NaN for NaN.
#[inline(always)]
fn exp_f32<const FMA: bool>(x: f32) -> f32 {
    // ln(2) in two parts; the first has few enough bits that n * LN2_HIGH is exact.
    const LN2_HIGH: f32 = EXP_LN2_HIGH as f32 / 512.0;
    const LN2_LOW: f32 = EXP_LN2_LOW;
    let multiply_add = f32::multiply_add::<FMA>;

    // Beyond these the result is infinite or zero anyway. Written so that NaN passes both.
    let low = if x < -104.0 { -104.0 } else { x };
    let x = if low > 89.0 { 89.0 } else { low };
    let shifted = multiply_add(x, core::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    let r = multiply_add(-n, LN2_LOW, multiply_add(-n, LN2_HIGH, x));
    let p = polynomial::<FMA>(&EXP, r);
    // n may be 128 or -150, which are no exponents of normal numbers; their halves are.
    let n = (shifted.to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32);
    let half = n >> 1;
    p * two_to(half) * two_to(n.wrapping_sub(half))
}

/// `ln(2^n m) = n ln(2) + ln(m)` with m between the square roots of 1/2 and 2, and `ln(m) = 2
/// artanh(s)` as a series in `s = (m - 1) / (m + 1)`.
#[inline(always)]
fn ln_f32(x: f32) -> f32 {
    const ROOT_HALF: u32 = core::f32::consts::FRAC_1_SQRT_2.to_bits();
    let n = (x.to_bits().wrapping_sub(ROOT_HALF) as i32) >> 23;
    let m = f32::from_bits(x.to_bits().wrapping_sub((n << 23) as u32));
    let s = (m - 1.0) / (m + 1.0);
    let t = s * s;
    let series = 2.0 + t * (2.0 / 3.0 + t * (2.0 / 5.0 + t * (2.0 / 7.0)));
    n as f32 * core::f32::consts::LN_2 + s * series
}

/// `2^n` for a small n, built from its exponent bits.
#[inline(always)]
fn two_to(n: i32) -> f32 {
    f32::from_bits(((n << 23) as u32).wrapping_add(1.0f32.to_bits()))
}

/// [`Real::exp2_neg`] of one number, for tests. `FMA` selects fused multiply-add.
#[cfg(test)]
pub(crate) fn exp2_neg_of_one<const FMA: bool>(t: f32) -> f32 {
    let t = t.least(115.0);
    let shifted = ROUND - t;
    let power = polynomial::<FMA>(&EXP2, t + (shifted - ROUND));
    f32::from_bits(power.to_bits().wrapping_add(shifted.to_bits() << 23))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check<const FMA: bool>() {
        let mut worst = 0.0f64;
        for i in 0..=2_400_000 {
            let t = i as f32 * 1e-5;
            let exact = (-f64::from(t)).exp2();
            worst = worst.max((f64::from(exp2_neg_of_one::<FMA>(t)) / exact - 1.0).abs());
        }
        println!("fused: {FMA}, worst relative error {worst:e}");
        assert!(worst < 2e-7, "worst relative error {worst:e}");
        assert!(exp2_neg_of_one::<FMA>(1e9) < 1e-30);
        assert!(exp2_neg_of_one::<FMA>(f32::NAN) < 1e-30);
        assert_eq!(exp2_neg_of_one::<FMA>(0.0), 1.0);
    }

    #[macerator::with_simd]
    fn exp2_neg_each<S: Simd>(values: &mut [f32]) {
        for lanes in values.chunks_exact_mut(f32::lanes::<S>()) {
            let t: Vector<S, f32> = bytemuck::pod_read_unaligned(bytemuck::cast_slice(lanes));
            let mut power = [t];
            f32::exp2_neg(&mut power);
            lanes.copy_from_slice(bytemuck::cast_slice(&power));
        }
    }

    #[test]
    fn rows_become_columns() {
        let rows = core::array::from_fn(|i| core::array::from_fn(|j| (4 * i + j) as f32));
        let columns = core::array::from_fn(|i| core::array::from_fn(|j| (4 * j + i) as f32));
        assert_eq!(f32::transposed(rows), columns);
        let wide = rows.map(|row: [f32; 4]| row.map(f64::from));
        assert_eq!(f64::transposed(wide), columns.map(|row| row.map(f64::from)));
    }

    /// Each step, with fused multiply-add and without.
    #[test]
    fn exp_in_registers_is_that_of_one() {
        let mut values: Vec<f32> = (0..1 << 18).map(|i| i as f32 * 1e-4).collect();
        let powers = |one: fn(f32) -> f32| -> Vec<f32> { values.iter().map(|t| one(*t)).collect() };
        let (fused, plain) = (
            powers(exp2_neg_of_one::<true>),
            powers(exp2_neg_of_one::<false>),
        );
        exp2_neg_each(&mut values);
        assert!(values == fused || values == plain);
    }

    fn check_anywhere<const FMA: bool>() {
        let mut worst = 0.0f64;
        for i in -8_700_000..=8_870_000 {
            let x = i as f32 * 1e-5;
            let exact = f64::from(x).exp();
            worst = worst.max((f64::from(<f32 as Real>::exp::<FMA>(x)) / exact - 1.0).abs());
        }
        println!("fused: {FMA}, worst relative error {worst:e}");
        assert!(worst < 2e-7, "worst relative error {worst:e}");
        // Subnormal numbers have fewer digits, and finally none.
        for x in [
            -88.0f32,
            -95.0,
            -103.0,
            -103.9,
            -105.0,
            -1e30,
            f32::NEG_INFINITY,
        ] {
            let error = f64::from(<f32 as Real>::exp::<FMA>(x)) - f64::from(x).exp();
            assert!(
                error.abs() <= 1.5 * f64::from(f32::from_bits(1)),
                "{x}: {error:e}"
            );
        }
        assert_eq!(<f32 as Real>::exp::<FMA>(0.0), 1.0);
        for x in [88.73, 89.0, 1e30, f32::INFINITY] {
            assert_eq!(<f32 as Real>::exp::<FMA>(x), f32::INFINITY, "{x}");
        }
        assert!(<f32 as Real>::exp::<FMA>(f32::NAN).is_nan());
    }

    #[test]
    fn ln_is_exact_to_seven_digits() {
        let mut worst = 0.0f64;
        for bits in (1.0f32.to_bits()..1e6f32.to_bits()).step_by(61) {
            for x in [f32::from_bits(bits), 1.0 / f32::from_bits(bits)] {
                let exact = f64::from(x).ln();
                worst = worst.max((f64::from(Real::ln(x)) - exact).abs() / exact.abs().max(1.0));
            }
        }
        println!("worst error {worst:e}");
        assert!(worst < 3e-7, "worst error {worst:e}");
    }

    #[test]
    fn exp_is_exact_to_two_ulp_anywhere() {
        check_anywhere::<true>();
        check_anywhere::<false>();
    }

    #[test]
    fn exp_is_exact_to_two_ulp_on_the_range_of_visible_splats() {
        check::<true>();
        check::<false>();
    }
}
