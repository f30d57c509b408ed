//! Quantisation of everything but the positions: for each array, how it is written and read.

use std::f64::consts::FRAC_1_SQRT_2;

use super::super::axes::AxisFlip;
use super::super::{SplatData, values};
use super::header::Header;
use super::{FLIP, SpzSettings};

/// Units of the colours' coefficient of degree 0, which leave room beyond black and white.
const COLOR: f64 = 0.15;
/// Log-scale of the byte 0.
const LEAST_SCALE: f64 = -10.0;
/// Steps of a log-scale per unit.
const SCALE_STEPS: f64 = 16.0;
/// Largest magnitude of 9 bits.
const NINE_BITS: u32 = 511;

fn byte(value: f64) -> u8 {
    // The conversion saturates, and minus infinity is 0.
    value.round() as u8
}

pub(super) fn encode_alphas(scene: &SplatData) -> Vec<u8> {
    let all = 0..scene.len();
    all.map(|index| byte(255.0 * values::opacity(scene, index)))
        .collect()
}

pub(super) fn encode_colors(scene: &SplatData) -> Vec<u8> {
    let all = scene.sh0.as_flattened().iter();
    all.map(|&sh0| byte(255.0 * (COLOR * f64::from(sh0) + 0.5)))
        .collect()
}

pub(super) fn decode_colors(bytes: &[u8]) -> Vec<[f32; 3]> {
    let value = |byte: u8| ((f64::from(byte) / 255.0 - 0.5) / COLOR) as f32;
    let each = bytes.as_chunks::<3>().0.iter();
    each.map(|color| color.map(value)).collect()
}

/// Largest magnitude of the coefficient of degree 0.
pub(super) const MOST_COLOR: f64 = 0.5 / COLOR;

pub(super) fn encode_scales(scene: &SplatData) -> Vec<u8> {
    let all = scene.log_scales.as_flattened().iter();
    all.map(|&scale| byte((f64::from(scale) - LEAST_SCALE) * SCALE_STEPS))
        .collect()
}

pub(super) fn decode_scales(bytes: &[u8]) -> Vec<[f32; 3]> {
    let value = |byte: u8| (f64::from(byte) / SCALE_STEPS + LEAST_SCALE) as f32;
    let each = bytes.as_chunks::<3>().0.iter();
    each.map(|scales| scales.map(value)).collect()
}

/// Log-scales that are written without being clamped.
pub(super) fn scale_fits(scale: f32) -> bool {
    let value = (f64::from(scale) - LEAST_SCALE) * SCALE_STEPS;
    (-0.5..=255.5).contains(&value)
}

pub(super) fn encode_rotations(scene: &SplatData) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(4 * scene.len());
    for index in 0..scene.len() {
        let [w, x, y, z] = FLIP.quat(values::unit_quat(scene, index));
        bytes.extend(smallest_three([x, y, z, w]).to_le_bytes());
    }
    bytes
}

/// A unit quaternion (x, y, z, w) without its largest component.
fn smallest_three(quat: [f64; 4]) -> u32 {
    let largest = values::largest(quat);
    let mut bits = largest as u32;
    for at in (0..4).filter(|&at| at != largest) {
        // The largest component, which is not written, is positive.
        let negative = (quat[at] < 0.0) != (quat[largest] < 0.0);
        let magnitude = f64::from(NINE_BITS) * quat[at].abs() / FRAC_1_SQRT_2;
        let magnitude = (magnitude.round() as u32).min(NINE_BITS);
        bits = bits << 10 | u32::from(negative) << 9 | magnitude;
    }
    bits
}

/// The unit quaternion (x, y, z, w) of [`smallest_three`].
fn from_smallest_three(mut bits: u32) -> [f64; 4] {
    let largest = (bits >> 30) as usize;
    let mut quat = [0.0; 4];
    for at in (0..4).rev().filter(|&at| at != largest) {
        let magnitude = f64::from(bits & NINE_BITS) / f64::from(NINE_BITS) * FRAC_1_SQRT_2;
        quat[at] = if bits & 0x200 == 0 {
            magnitude
        } else {
            -magnitude
        };
        bits >>= 10;
    }
    quat[largest] = rest_of_unit(&quat);
    quat
}

/// The missing component of a unit quaternion; 0 if the others are too large already.
fn rest_of_unit(quat: &[f64]) -> f64 {
    (1.0 - quat.iter().map(|q| q * q).sum::<f64>())
        .max(0.0)
        .sqrt()
}

pub(super) fn decode_rotations(header: &Header, bytes: &[u8], flip: AxisFlip) -> Vec<[f32; 4]> {
    let ours = |[x, y, z, w]: [f64; 4]| flip.quat([w, x, y, z]).map(|q| q as f32);
    if header.version >= 3 {
        let each = bytes.as_chunks::<4>().0.iter();
        return each
            .map(|b| ours(from_smallest_three(u32::from_le_bytes(*b))))
            .collect();
    }
    let each = bytes.as_chunks::<3>().0.iter();
    each.map(|b| {
        let [x, y, z] = b.map(|q| f64::from(q) / 127.5 - 1.0);
        ours([x, y, z, rest_of_unit(&[x, y, z])])
    })
    .collect()
}

pub(super) fn encode_sh(scene: &SplatData, settings: &SpzSettings) -> Vec<u8> {
    let signs = FLIP.sh_rest();
    let rest = scene.sh_rest_len();
    let all = scene.sh_rest.iter().enumerate();
    all.map(|(at, &value)| {
        // `rest` is not 0, or there would be no value.
        let coefficient = at % rest / 3;
        let bits = match coefficient < 3 {
            true => settings.sh1_bits,
            false => settings.sh_rest_bits,
        };
        sh_byte(signs[coefficient] * value, bits)
    })
    .collect()
}

/// A coefficient as a multiple of 2^(8 - bits); 128 is 0 whatever the bits. Rounded once: other
/// writers round to a byte first and then halves upwards, which shifts every colour.
fn sh_byte(value: f32, bits: u8) -> u8 {
    let bucket = f32::from(1u16 << (8 - bits));
    let steps = bucket * (128.0 * value / bucket).round() + 128.0;
    // Saturates.
    steps as u8
}

pub(super) fn decode_sh(header: &Header, bytes: &[u8], flip: AxisFlip) -> Vec<f32> {
    let each = header.sh_values();
    if each == 0 {
        return vec![];
    }
    let signs = flip.sh_rest();
    let kept = each.min(3 * signs.len());
    let mut values = Vec::with_capacity(bytes.len() / each * kept);
    for one in bytes.chunks_exact(each) {
        let coefficients = one[..kept].iter().enumerate();
        values.extend(coefficients.map(|(at, &b)| signs[at / 3] * (f32::from(b) - 128.0) / 128.0));
    }
    values
}
