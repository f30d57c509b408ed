//! Tests on floats that no compiler optimises away.

use cubecl::prelude::*;

/// Neither infinite nor NaN, by the bits: shading languages let a compiler assume that there is no
/// NaN, which makes comparisons an unsafe test.
#[cube]
pub(crate) fn is_finite(value: f32) -> bool {
    (u32::reinterpret(value) & 0x7f80_0000u32) != 0x7f80_0000u32
}

/// Less than zero, by the bits: false for NaN and for either zero.
#[cube]
pub(crate) fn is_below_zero(value: f32) -> bool {
    let bits = u32::reinterpret(value);
    bits > 0x8000_0000u32 && bits <= 0xff80_0000u32
}
