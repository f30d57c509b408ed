//! exp, one of our own: device libraries differ from each other by several units in the last place.
//!
//! `exp(-sigma) = 2^n e^r` with `|r| <= ln(2) / 2` and a polynomial of degree 5 for `e^r`, the same coefficients in the
//! same order as on the native path of `splat-ops`. Every product and sum is a spelled-out fused multiply-add on both:
//! where the device fuses, both give the same bits; where it does not, they differ in the last place. No compiler is
//! left the choice, so that the forward and the backward kernel round alike. Floor: 15 operations.

use cubecl::prelude::*;

use crate::launch::{Buffer, per_element};

/// 1.5 * 2^23: adding it rounds to the nearest integer and leaves that integer in the low bits.
const ROUND: f32 = 12_582_912.0;
const ROUND_BITS: i32 = 0x4b40_0000;
/// ln(2) in two parts; the first has so few bits that an integer below 128 times it is exact.
const LN2_HIGH: f32 = 0.693_359_4;
const LN2_LOW: f32 = -2.121_944_4e-4;
const LOG2_E: f32 = std::f32::consts::LOG2_E;

/// `exp(-sigma)` for `sigma >= 0`; above 80, and for NaN, it is `exp(-80)`.
#[cube]
pub(crate) fn exp_neg(sigma: f32) -> f32 {
    let x = -select(sigma < 80.0f32, sigma, 80.0f32);
    let shifted = fma(x, LOG2_E, ROUND);
    // n by its bits: shading languages let a compiler cancel ROUND in (x + ROUND) - ROUND.
    let integer = i32::reinterpret(shifted) - ROUND_BITS;
    let n = integer as f32;
    // The same number by another way: Mesa draws x - n HIGH - n LOW together to x - n (HIGH + LOW), which would undo
    // the two parts of ln(2). Twice n times half of LOW has the same bits as n times LOW.
    let n_twice = (integer * 2i32) as f32;
    let r = fma(-n_twice, 0.5f32 * LN2_LOW, fma(-n, LN2_HIGH, x));
    let mut p = 0.008_290_315f32;
    p = fma(p, r, 0.041_897_93f32);
    p = fma(p, r, 0.166_676_36f32);
    p = fma(p, r, 0.499_991_5f32);
    p = fma(p, r, 0.999_999_7f32);
    p = fma(p, r, 1.0f32);
    // The low bits of `shifted` are n; moved into the exponent they make 2^n.
    p * f32::reinterpret((u32::reinterpret(shifted) << 23u32) + 0x3f80_0000u32)
}

#[cube(launch)]
fn exp_neg_kernel(sigmas: &[f32], output: &mut [f32], len: u32) {
    if ABSOLUTE_POS < len as usize {
        output[ABSOLUTE_POS] = exp_neg(sigmas[ABSOLUTE_POS]);
    }
}

/// `exp(-sigma)` of every element, as the rasteriser computes it: to measure that function on a device.
pub fn exp_neg_each(client: &Client, sigmas: &Buffer) -> Buffer {
    let output = Buffer::empty(client, sigmas.len());
    if let Some((count, dim)) = per_element(sigmas.len()) {
        exp_neg_kernel::launch(
            client,
            count,
            dim,
            sigmas.arg(),
            output.arg(),
            sigmas.len() as u32,
        );
    }
    output
}
