//! Positions on a grid of 24-bit integers.

use std::path::Path;

use super::super::axes::AxisFlip;
use super::super::{SceneFileError, SplatData};
use super::header::{Header, MOST_FRACTIONAL_BITS};
use super::{FLIP, half};

/// Largest integer of 24 bits with a sign.
const MOST: f64 = ((1 << 23) - 1) as f64;
/// Coarsest step of a scene with an origin, in its scales. A millimetre at ten metres.
const COARSEST: f64 = 1e-4;

/// The step of the positions of a file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Grid {
    fractional_bits: u8,
}

impl Grid {
    /// The finest grid that holds the farthest Gaussian, or that of `bits`.
    pub fn choose(
        path: &Path,
        scene: &SplatData,
        bits: Option<u8>,
    ) -> Result<Self, SceneFileError> {
        let bad = |reason: String| SceneFileError::Field {
            path: path.to_path_buf(),
            field: "positions",
            reason,
        };
        let (index, farthest) = farthest(scene);
        let finest = Self::finest(farthest);
        let Some(finest) = finest else {
            return Err(bad(format!(
                "Gaussian {index} lies at {farthest}; SPZ reaches up to {MOST}, so scale the scene down, or write PLY or SOG"
            )));
        };
        let grid = match bits {
            None => finest,
            Some(bits) if bits <= finest.fractional_bits => Self {
                fractional_bits: bits,
            },
            Some(bits) => {
                return Err(bad(format!(
                    "Gaussian {index} lies at {farthest}, which leaves {} fractional bits, not {bits}",
                    finest.fractional_bits
                )));
            }
        };
        let coarsest = COARSEST * scene.scene_scale().length();
        if scene.origin != [0.0; 3] && grid.step() > coarsest {
            let [x, y, z] = scene.origin;
            return Err(bad(format!(
                "the scene's origin is {x} {y} {z}; so far from zero, SPZ would round positions to {}. \
                 Leave the origin out (`splat convert --drop-origin`), or write PLY or SOG",
                grid.step()
            )));
        }
        Ok(grid)
    }

    /// The finest grid that reaches `farthest`.
    pub fn finest(farthest: f64) -> Option<Self> {
        let fits = |bits: &u8| (farthest * power(*bits)).round() <= MOST;
        let fractional_bits = (0..=MOST_FRACTIONAL_BITS).rev().find(fits)?;
        Some(Self { fractional_bits })
    }

    pub fn fractional_bits(self) -> u8 {
        self.fractional_bits
    }

    /// Distance between neighbouring positions, world units.
    pub fn step(self) -> f64 {
        1.0 / power(self.fractional_bits)
    }

    /// The array of a scene's positions, which all fit.
    pub fn encode(self, scene: &SplatData) -> Vec<u8> {
        let scale = power(self.fractional_bits);
        let mut bytes = Vec::with_capacity(9 * scene.len());
        for index in 0..scene.len() {
            for value in FLIP.position(position(scene, index)) {
                let fixed = (value * scale).round().clamp(-MOST, MOST) as i32;
                bytes.extend(&fixed.to_le_bytes()[..3]);
            }
        }
        bytes
    }
}

fn power(bits: u8) -> f64 {
    2f64.powi(i32::from(bits))
}

/// Position in the world.
fn position(scene: &SplatData, index: usize) -> [f64; 3] {
    let mean = scene.means[index];
    std::array::from_fn(|axis| scene.origin[axis] + f64::from(mean[axis]))
}

/// The Gaussian with the largest coordinate, and that coordinate's magnitude.
pub(super) fn farthest(scene: &SplatData) -> (usize, f64) {
    let reach = |index| {
        position(scene, index)
            .into_iter()
            .map(f64::abs)
            .fold(0.0, f64::max)
    };
    let all = (0..scene.len()).map(|index| (index, reach(index)));
    all.fold(
        (0, 0.0),
        |most, one| if one.1 > most.1 { one } else { most },
    )
}

/// Means from the array of positions.
pub(super) fn decode(
    path: &Path,
    header: &Header,
    bytes: &[u8],
    flip: AxisFlip,
) -> Result<Vec<[f32; 3]>, SceneFileError> {
    // Without minus zero.
    let flipped = |position| flip.position(position).map(|value| value as f32 + 0.0);
    if header.version > 1 {
        let step = 1.0 / power(header.fractional_bits);
        let fixed = |b: &[u8]| {
            // In the upper bytes, so that the sign is that of 32 bits.
            f64::from(i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8) * step
        };
        let each = bytes.as_chunks::<9>().0.iter();
        return Ok(each
            .map(|b| flipped([fixed(&b[..3]), fixed(&b[3..6]), fixed(&b[6..])]))
            .collect());
    }
    let each = bytes.as_chunks::<6>().0.iter().enumerate();
    each.map(|(index, b)| {
        let halves = [[b[0], b[1]], [b[2], b[3]], [b[4], b[5]]];
        let position = halves.map(|half| half::to_f64(u16::from_le_bytes(half)));
        match position.iter().position(|value| !value.is_finite()) {
            None => Ok(flipped(position)),
            Some(at) => Err(SceneFileError::NotFinite {
                path: path.to_path_buf(),
                index,
                property: ["x", "y", "z"][at].to_owned(),
                value: position[at] as f32,
            }),
        }
    })
    .collect()
}
