//! Polynomials of the exponentials, shared by all backends.

/// `1.5 * 2^23`: adding it to an f32 rounds that to the nearest integer, and leaves the integer in
/// the low bits.
pub const ROUND_TO_INTEGER: f32 = 12_582_912.0;

/// Coefficients, from degree 5 down, of the polynomial with p(0) = 1 that minimises the largest
/// relative error from `2^-g` on `|g| <= 1/2`, 1.1e-7.
pub const EXP2_NEG: [f32; 6] = [
    -0.001_326_472_7,
    0.009_671_513,
    -0.055_507_336,
    0.240_222_42,
    -0.693_146_94,
    1.0,
];

/// Coefficients, from degree 5 down, of the polynomial for `e^r` on `|r| <= ln(2) / 2`; largest
/// relative error 9.1e-8.
pub const EXP: [f32; 6] = [
    0.008_290_315,
    0.041_897_93,
    0.166_676_36,
    0.499_991_5,
    0.999_999_7,
    1.0,
];

/// `EXP_LN2_HIGH / 512` approximates ln(2) in few enough bits that its multiples are exact.
pub const EXP_LN2_HIGH: i32 = 355;

/// Remainder of ln(2).
pub const EXP_LN2_LOW: f32 = -2.121_944_4e-4;
