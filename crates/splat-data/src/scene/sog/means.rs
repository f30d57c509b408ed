//! Positions: 16 bits of a logarithm, and their order along a Morton curve.

use super::super::SplatData;
use super::meta::Means;

/// Largest of 16 bits.
const MOST: f64 = 65_535.0;

/// The logarithm whose range is divided into steps: fine near zero, coarse far from it.
fn log(x: f64) -> f64 {
    x.abs().ln_1p().copysign(x)
}

/// The inverse of [`log`].
fn exp(t: f64) -> f64 {
    t.abs().exp_m1().copysign(t)
}

/// Quantised positions of all Gaussians.
pub(super) struct Codes {
    /// Least logarithm of each axis.
    pub least: [f64; 3],
    /// Largest logarithm of each axis.
    pub most: [f64; 3],
    codes: Vec<[u16; 3]>,
}

/// Quantises the positions of a scene.
pub(super) fn encode(scene: &SplatData) -> Codes {
    let logs = || {
        scene
            .means
            .iter()
            .map(|mean| mean.map(|x| log(f64::from(x))))
    };
    let (mut least, mut most) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for t in logs() {
        for axis in 0..3 {
            least[axis] = least[axis].min(t[axis]);
            most[axis] = most[axis].max(t[axis]);
        }
    }
    let code = |t: [f64; 3]| {
        std::array::from_fn(|axis| {
            let range = most[axis] - least[axis];
            // Saturates, and is 0 for an axis without a range.
            (MOST * (t[axis] - least[axis]) / range).round() as u16
        })
    };
    Codes {
        codes: logs().map(code).collect(),
        least,
        most,
    }
}

impl Codes {
    /// Gaussians in the order of the file: along a Morton curve, so that neighbours in space are
    /// neighbours in the images.
    pub fn order(&self) -> Vec<u32> {
        let mut keys: Vec<(u64, u32)> = (0u32..)
            .zip(&self.codes)
            .map(|(index, code)| (morton(*code), index))
            .collect();
        keys.sort_unstable();
        keys.into_iter().map(|(_, index)| index).collect()
    }

    /// Pixels of the lower and the higher bytes.
    pub fn pixels(&self, order: &[u32]) -> (Vec<[u8; 3]>, Vec<[u8; 3]>) {
        let byte = |at: usize| {
            let codes = order.iter().map(|&index| self.codes[index as usize]);
            codes.map(move |code| code.map(|code| code.to_le_bytes()[at]))
        };
        (byte(0).collect(), byte(1).collect())
    }
}

/// Interleaves the bits of three numbers.
fn morton(code: [u16; 3]) -> u64 {
    let spread = |code: u16| {
        let mut bits = u64::from(code);
        bits = (bits | bits << 16) & 0x0000_00ff_0000_ffff;
        bits = (bits | bits << 16) & 0x00ff_0000_ff00_00ff;
        bits = (bits | bits << 8) & 0xf00f_00f0_0f00_f00f;
        bits = (bits | bits << 4) & 0x30c3_0c30_c30c_30c3;
        (bits | bits << 2) & 0x9249_2492_4924_9249
    };
    spread(code[0]) | spread(code[1]) << 1 | spread(code[2]) << 2
}

/// Positions from the pixels of both bytes.
pub(super) fn decode(means: &Means, low: &[[u8; 4]], high: &[[u8; 4]]) -> Vec<[f32; 3]> {
    let pixels = low.iter().zip(high);
    pixels
        .map(|(low, high)| {
            std::array::from_fn(|axis| {
                let code = f64::from(u16::from_le_bytes([low[axis], high[axis]]));
                let (least, most) = (means.mins[axis], means.maxs[axis]);
                exp(least + (most - least) * (code / MOST)) as f32
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_are_interleaved() {
        let slowly = |code: [u16; 3]| {
            let bits = (0..48).map(|bit| u64::from(code[bit % 3] >> (bit / 3) & 1) << bit);
            bits.sum::<u64>()
        };
        for code in [
            [1, 0, 0],
            [0xffff, 0, 0],
            [0x1234, 0xfedc, 0x8421],
            [0xffff; 3],
        ] {
            assert_eq!(morton(code), slowly(code), "{code:x?}");
        }
    }

    #[test]
    fn the_logarithm_has_an_inverse() {
        for x in [0.0, -0.0, 1e-9, -2.5, 1e6] {
            assert!((exp(log(x)) - x).abs() <= 1e-12 * (1.0 + x.abs()));
        }
    }
}
