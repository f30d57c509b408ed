//! The pixels of a block in registers.
//!
//! Written with SIMD types, where elsewhere loops over lanes become SIMD code: these passes are
//! most of a training step, and the compiler's guesses at such loops change with what stands around
//! them.

use macerator::{Mask, Simd, Vector};

use super::super::real::Real;
use super::lanes::{Aligned, LANES, Lanes, SIDE};

/// Computes a value for every register that is used.
// No closure: the compiler must put every function between the instructions and the one that is
// compiled for them into the latter, and knows no way to be told so of closures.
macro_rules! each_register {
    ($i:ident => $value:expr) => {{
        let mut result = Registers([T::ZERO.splat(); _]);
        for $i in 0..result.used() {
            result.0[$i] = $value;
        }
        result
    }};
}

/// Some values of one block, side by side in as many registers as it takes.
// An array as long as registers of one lane would make it, as its length has to be known; the
// compiler drops what is not used.
pub(super) struct Registers<S: Simd, T: Real, const VALUES: usize>([Vector<S, T>; VALUES]);

/// One value per pixel of a block.
pub(super) type Pixels<S, T> = Registers<S, T, LANES>;

/// One value per column of a block: in one register, or more where they are narrower than a row. A
/// wider one holds it once for every row.
pub(super) type Columns<S, T> = Registers<S, T, SIDE>;

impl<S: Simd, T: Real, const VALUES: usize> Clone for Registers<S, T, VALUES> {
    #[inline(always)]
    fn clone(&self) -> Self {
        *self
    }
}

impl<S: Simd, T: Real, const VALUES: usize> Copy for Registers<S, T, VALUES> {}

impl<S: Simd, T: Real, const VALUES: usize> Registers<S, T, VALUES> {
    /// How many registers that are.
    #[inline(always)]
    fn used(&self) -> usize {
        VALUES.div_ceil(T::lanes::<S>())
    }

    /// Values of every pixel, or of every column of pixels whose rows are alike.
    #[inline(always)]
    pub(super) fn load(lanes: &Lanes<T>) -> Self {
        each_register!(i => register(lanes, i))
    }

    /// As [`load`](Self::load) takes it.
    #[inline(always)]
    pub(super) fn store(self, lanes: &mut Lanes<T>) {
        for i in 0..self.used() {
            store_register(self.0[i], lanes, i);
        }
    }

    #[inline(always)]
    pub(super) fn splat(value: T) -> Self {
        Self([value.splat(); VALUES])
    }

    #[inline(always)]
    pub(super) fn plus(self, other: Self) -> Self {
        each_register!(i => self.0[i] + other.0[i])
    }

    #[inline(always)]
    pub(super) fn times(self, other: Self) -> Self {
        each_register!(i => self.0[i] * other.0[i])
    }

    /// `sum + self b`, summed over the registers.
    #[inline(always)]
    pub(super) fn times_add_to(self, b: Self, sum: &mut Vector<S, T>) {
        for i in 0..self.used() {
            *sum = self.0[i].mul_add(b.0[i], *sum);
        }
    }
}

impl<S: Simd, T: Real> Pixels<S, T> {
    #[inline(always)]
    pub(super) fn lanes(self) -> Lanes<T> {
        let mut lanes = [T::ZERO; LANES];
        self.store(&mut lanes);
        lanes
    }

    #[inline(always)]
    pub(super) fn minus(self, other: Self) -> Self {
        each_register!(i => self.0[i] - other.0[i])
    }

    /// The lesser one; the other if one is NaN, or NaN, as the processor has it.
    #[inline(always)]
    pub(super) fn least(self, other: Self) -> Self {
        each_register!(i => self.0[i].min(other.0[i]))
    }

    /// `self b + c`, in one rounding where that is one instruction.
    #[inline(always)]
    pub(super) fn times_plus(self, b: Self, c: Self) -> Self {
        each_register!(i => self.0[i].mul_add(b.0[i], c.0[i]))
    }

    /// `c - self b`, likewise.
    #[inline(always)]
    pub(super) fn times_from(self, b: Self, c: Self) -> Self {
        // Subtracted from -0, which is how a compiler knows a change of sign; it becomes part of
        // the instruction.
        let sign = T::of(-0.0).splat();
        each_register!(i => (sign - self.0[i]).mul_add(b.0[i], c.0[i]))
    }

    /// `2^-self`, see [`Real::exp2_neg`].
    #[inline(always)]
    pub(super) fn exp2_neg(self) -> Self {
        let mut powers = self;
        T::exp2_neg(&mut powers.0[..self.used()]);
        powers
    }

    /// These values where `values >= bound`, and zero elsewhere.
    #[inline(always)]
    pub(super) fn where_at_least(self, values: Self, bound: Self) -> Self {
        each_register!(i => kept(values.0[i].ge(bound.0[i]), self.0[i]))
    }

    /// These values where `values < bound`, and zero elsewhere.
    #[inline(always)]
    pub(super) fn where_below(self, values: Self, bound: Self) -> Self {
        each_register!(i => kept(values.0[i].lt(bound.0[i]), self.0[i]))
    }

    /// Absolute values.
    #[inline(always)]
    pub(super) fn magnitudes(self) -> Self {
        each_register!(i => self.0[i].max(T::ZERO.splat() - self.0[i]))
    }

    /// Whether any pixel is below.
    #[inline(always)]
    pub(super) fn any_below(self, bound: T) -> bool {
        let mut least = self.0[0];
        for i in 1..self.used() {
            least = least.min(self.0[i]);
        }
        least.lt(bound.splat()).any()
    }

    /// Sums over the rows.
    #[inline(always)]
    pub(super) fn column_sums(self) -> Columns<S, T> {
        let mut sums = Columns::splat(T::ZERO);
        let count = sums.used();
        for i in 0..count {
            sums.0[i] = self.0[i];
            for row in (i + count..self.used()).step_by(count) {
                sums.0[i] += self.0[row];
            }
        }
        sums
    }
}

impl<S: Simd, T: Real> Columns<S, T> {
    /// The same in every row.
    #[inline(always)]
    pub(super) fn pixels(self) -> Pixels<S, T> {
        each_register!(i => self.0[i % self.used()])
    }

    /// `sum + self`, summed over the registers.
    #[inline(always)]
    pub(super) fn add_to(self, sum: &mut Vector<S, T>) {
        for i in 0..self.used() {
            *sum += self.0[i];
        }
    }
}

/// A register where a mask is set, and zero elsewhere.
#[inline(always)]
fn kept<S: Simd, T: Real>(mask: Mask<S, T>, register: Vector<S, T>) -> Vector<S, T> {
    let bits = bytemuck::bytes_of(&*mask);
    if bits.len() != size_of::<Vector<S, T>>() {
        return mask.select(register, T::ZERO.splat());
    }
    // A mask of a register's size has all bits of a lane set or none, which makes this one
    // operation instead of two.
    let bits: Vector<S, u32> = bytemuck::pod_read_unaligned(bits);
    (bits & register.reinterpret()).reinterpret()
}

/// The sum of a register's lanes: halves are added to halves.
#[inline(always)]
pub(super) fn total<S: Simd, T: Real>(register: Vector<S, T>) -> T {
    let [a, b, c, d] = quarters(register);
    (a + c) + (b + d)
}

/// Four of them.
#[inline(always)]
pub(super) fn four_totals<S: Simd, T: Real>(registers: [Vector<S, T>; 4]) -> [T; 4] {
    let [a, b, c, d] = registers;
    let [a, b, c, d] = T::transposed([quarters(a), quarters(b), quarters(c), quarters(d)]);
    T::sums(T::sums(a, c), T::sums(b, d))
}

/// A register's lanes added up to four, zeros where there are fewer.
#[inline(always)]
fn quarters<S: Simd, T: Real>(register: Vector<S, T>) -> [T; 4] {
    let mut lanes = [T::ZERO; LANES];
    let width = T::lanes::<S>();
    lanes[..width].copy_from_slice(bytemuck::cast_slice(core::slice::from_ref(&register)));
    let fours = lanes.as_chunks().0;
    match width {
        16 => T::sums(T::sums(fours[0], fours[2]), T::sums(fours[1], fours[3])),
        8 => T::sums(fours[0], fours[1]),
        _ => fours[0],
    }
}

/// Several.
#[inline(always)]
pub(super) fn load_each<S: Simd, T: Real, const COUNT: usize>(
    lanes: &[Aligned<Lanes<T>>],
) -> [Pixels<S, T>; COUNT] {
    let mut pixels = [Pixels::splat(T::ZERO); COUNT];
    for i in 0..COUNT {
        pixels[i] = Pixels::load(&lanes[i].0);
    }
    pixels
}

#[inline(always)]
fn register<S: Simd, T: Real>(lanes: &Lanes<T>, i: usize) -> Vector<S, T> {
    let width = T::lanes::<S>();
    bytemuck::pod_read_unaligned(bytemuck::cast_slice(&lanes[i * width..(i + 1) * width]))
}

#[inline(always)]
fn store_register<S: Simd, T: Real>(register: Vector<S, T>, lanes: &mut Lanes<T>, i: usize) {
    let width = T::lanes::<S>();
    let values: &[T] = bytemuck::cast_slice(core::slice::from_ref(&register));
    lanes[i * width..(i + 1) * width].copy_from_slice(values);
}
