//! Tests on floats that no compiler optimises away.

use cubecl::prelude::*;

/// Neither infinite nor NaN, by the bits: shading languages let a compiler assume that there is no NaN, which makes
/// comparisons an unsafe test.
#[cube]
pub(crate) fn is_finite(value: f32) -> bool {
    (u32::reinterpret(value) & 0x7f80_0000u32) != 0x7f80_0000u32
}
