//! Exponentials. Device libraries differ from each other by several units in the last place, so the
//! kernels have their own.
//!
//! `2^-t = 2^n 2^-g` with `|g| <= 1/2`, an exact g, and a polynomial of degree 5 for `2^-g`; `e^x`
//! works the same for any x. Both use the coefficients of the native path of `splat-ops`, in the
//! same order, and spell out every multiply-add as fused, as the native path does. If the device
//! fuses, both give the same bits; if not, they differ in the last place. The compiler has no
//! choice, so the forward and backward kernels round alike. Floor: 15 operations; 22 for any x.

use cubecl::prelude::*;
use splat_core::exp::{EXP, EXP_LN2_HIGH, EXP_LN2_LOW, EXP2_NEG, ROUND_TO_INTEGER};

use crate::launch::{Buffer, per_element};

const ROUND: f32 = ROUND_TO_INTEGER;
const ROUND_BITS: i32 = ROUND_TO_INTEGER.to_bits() as i32;

// Kernels take constants individually.
const TWO_5: f32 = EXP2_NEG[0];
const TWO_4: f32 = EXP2_NEG[1];
const TWO_3: f32 = EXP2_NEG[2];
const TWO_2: f32 = EXP2_NEG[3];
const TWO_1: f32 = EXP2_NEG[4];
const E_5: f32 = EXP[0];
const E_4: f32 = EXP[1];
const E_3: f32 = EXP[2];
const E_2: f32 = EXP[3];
const E_1: f32 = EXP[4];

/// Horner's rule; coefficients from degree 5 down, the last being 1.
#[cube]
fn polynomial(x: f32, c5: f32, c4: f32, c3: f32, c2: f32, c1: f32) -> f32 {
    let lower = fma(fma(fma(c5, x, c4), x, c3), x, c2);
    fma(fma(lower, x, c1), x, 1.0f32)
}

/// `2^-t` for `t >= 0`; above 115, and for NaN, it is `2^-115`.
#[cube]
pub(crate) fn exp2_neg(t: f32) -> f32 {
    let t = select(t < 115.0f32, t, 115.0f32);
    let shifted = ROUND - t;
    // n from its bits: shading languages let a compiler cancel ROUND in (ROUND - t) - ROUND.
    let g = t + (i32::reinterpret(shifted) - ROUND_BITS) as f32;
    let p = polynomial(g, TWO_5, TWO_4, TWO_3, TWO_2, TWO_1);
    // The low bits of `shifted` are n; added to the exponent they multiply by 2^n.
    f32::reinterpret(u32::reinterpret(p) + (u32::reinterpret(shifted) << 23u32))
}

/// ln(2) in two parts; the first is over 512, so that n times it is exact.
const LN2_HIGH: i32 = EXP_LN2_HIGH;
const LN2_LOW: f32 = EXP_LN2_LOW;

/// `exp(x) = 2^n e^r` with `|r| <= ln(2) / 2`, for any x: infinity and zero out of range, NaN for
/// NaN.
#[cube]
pub(crate) fn exp(x: f32) -> f32 {
    // Beyond these the result is infinite or zero anyway. Written so that NaN passes both.
    let x = select(x < -104.0f32, -104.0f32, x);
    let x = select(x > 89.0f32, 89.0f32, x);
    let shifted = fma(x, core::f32::consts::LOG2_E, ROUND);
    let n = i32::reinterpret(shifted) - ROUND_BITS;
    // Multiplied as integers: of two float products with a common factor a compiler may make one.
    let high = x - (n * LN2_HIGH) as f32 / 512.0f32;
    let r = fma(-(n as f32), LN2_LOW, high);
    let p = polynomial(r, E_5, E_4, E_3, E_2, E_1);
    // n may be 128 or -150, which are no exponents of normal numbers; their halves are.
    let n = u32::reinterpret(n);
    let half = ((n + 1024u32) >> 1u32) - 512u32;
    p * two_to(half) * two_to(n - half)
}

/// `2^n` of a small n (the complement, if negative), built from its exponent bits.
#[cube]
fn two_to(n: u32) -> f32 {
    f32::reinterpret((n << 23u32) + 0x3f80_0000u32)
}

#[cube(launch)]
fn exp2_neg_kernel(values: &[f32], output: &mut [f32], len: u32) {
    if ABSOLUTE_POS < len as usize {
        output[ABSOLUTE_POS] = exp2_neg(values[ABSOLUTE_POS]);
    }
}

/// `2^-t` of every element, as the rasteriser computes it, to measure the function on a device.
pub fn exp2_neg_each(client: &Client, values: &Buffer) -> Buffer {
    let output = Buffer::empty(client, values.len());
    if let Some((count, dim)) = per_element(values.len()) {
        exp2_neg_kernel::launch(
            client,
            count,
            dim,
            values.arg(),
            output.arg(),
            values.len() as u32,
        );
    }
    output
}
