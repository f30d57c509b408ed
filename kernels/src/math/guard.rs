//! Tests on floats that no compiler optimises away.

use cubecl::prelude::*;

/// Neither infinite nor NaN, by the bits: shading languages let a compiler assume that there is no NaN, which makes
/// comparisons an unsafe test.
#[cube]
pub(crate) fn is_finite(value: f32) -> bool {
    (u32::reinterpret(value) & 0x7f80_0000u32) != 0x7f80_0000u32
}

/// `a + b c` with one rounding wherever the device has it. Written out where two kernels must come to the same bits:
/// it leaves the compiler nothing to contract on its own.
#[cube]
pub(crate) fn fma_add(a: f32, b: f32, c: f32) -> f32 {
    fma(b, c, a)
}
