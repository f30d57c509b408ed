//! Rounding errors of differences.

use super::sample::{Extent, LEVELS, RATIO, Sample};

/// Rounding of two values, divided by the two steps between them.
const ROUNDING: f64 = 0.5 * f64::EPSILON;

/// Rounding error of one output element.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Noise {
    /// Multiple of the rounding of the element itself.
    pub factor: f64,
    /// Additional error, independent of the element's size.
    pub floor: f64,
}

impl Noise {
    /// Noise of a function that is exact except for its last rounding.
    pub(super) const LEAST: Self = Self {
        factor: 1.0,
        floor: 0.0,
    };

    /// Noise of differences along one line, at a step of one.
    pub(super) fn of(self, extent: Extent) -> f64 {
        ROUNDING * self.factor * extent.size + self.floor * extent.weight
    }

    /// Noise that explains an error of `found` in differences along a line, at a step of one.
    pub(super) fn that_explains(found: f64, at: Extent) -> Self {
        let factor = found / (ROUNDING * at.size);
        if factor <= 4.0 {
            return Self {
                factor: factor.max(1.0),
                floor: 0.0,
            };
        }
        // Rounding inside the function: proportional to the outputs, or constant.
        Self {
            factor,
            floor: found / at.weight,
        }
    }
}

/// Rounding error of differences at a step of one, from the smallest steps: the largest `|change of
/// the difference| * step`.
pub(super) fn noise_at_the_bottom<E>(
    first: f64,
    mut sample: impl FnMut(f64) -> Result<Option<Sample>, E>,
) -> Result<Option<f64>, E> {
    let last = first / RATIO.powi(LEVELS as i32 - 1);
    let (mut noise, mut before): (Option<f64>, Option<f64>) = (None, None);
    for factor in [RATIO * RATIO, RATIO, 1.0] {
        let step = last * factor;
        let central = sample(step)?.map(|at| at.central);
        if let (Some(before), Some(central)) = (before, central) {
            let change = (central - before).abs() * step;
            noise = Some(noise.map_or(change, |noise| noise.max(change)));
        }
        before = central;
    }
    Ok(noise)
}
