//! Tests on floats that no compiler optimises away.

use cubecl::prelude::*;

/// Neither infinite nor NaN, tested on the bits: shading languages let a compiler assume that there
/// is no NaN, so comparisons are unreliable.
#[cube]
pub(crate) fn is_finite(value: f32) -> bool {
    (u32::reinterpret(value) & 0x7f80_0000u32) != 0x7f80_0000u32
}

/// Less than zero, tested on the bits: false for NaN and for both zeros.
#[cube]
pub(crate) fn is_below_zero(value: f32) -> bool {
    let bits = u32::reinterpret(value);
    bits > 0x8000_0000u32 && bits <= 0xff80_0000u32
}
