//! A function along a line through its inputs.

use std::ops::Range;

use super::CheckError;
use super::function::Function;
use super::inputs::Inputs;
use super::sample::Extent;
use super::sample::Sample;

/// Moves of some elements of one input.
#[derive(Debug, Clone)]
pub(super) struct Line<'a> {
    pub input: usize,
    pub range: Range<usize>,
    /// Move of every element of the input; elements outside `range` stay.
    pub moves: &'a [f64],
}

/// Evaluates a function along lines, with fixed weights of its outputs.
///
/// Outputs are subtracted elementwise before they are summed. Unchanged values cancel exactly, and
/// rounding is that of the elements, not that of their sum.
pub(super) struct Probe<'a> {
    function: &'a dyn Function,
    inputs: Inputs,
    /// Outputs at the original inputs.
    middle: Vec<f64>,
    weights: Vec<f64>,
    /// Inputs being moved.
    moved: Inputs,
}

impl<'a> Probe<'a> {
    pub(super) fn new(
        function: &'a dyn Function,
        inputs: Inputs,
        middle: Vec<f64>,
        weights: Vec<f64>,
    ) -> Self {
        Self {
            function,
            moved: inputs.clone(),
            inputs,
            middle,
            weights,
        }
    }

    /// Differences at one step. `None` if an output is not finite.
    pub(super) fn sample(&mut self, line: &Line, step: f64) -> Result<Option<Sample>, CheckError> {
        let right = self.at(line, step)?;
        let left = self.at(line, -step)?;
        let (mut central, mut jump, mut size, mut weights) = (0.0, 0.0, 0.0, 0.0);
        for (((right, left), middle), weight) in
            right.iter().zip(&left).zip(&self.middle).zip(&self.weights)
        {
            if !(right.is_finite() && left.is_finite()) {
                return Ok(None);
            }
            if right == middle && left == middle {
                continue;
            }
            central += weight * (right - left);
            jump += weight * ((right - middle) - (middle - left));
            let largest = right.abs().max(left.abs()).max(middle.abs());
            size += (weight * largest).powi(2);
            weights += weight * weight;
        }
        Ok(Some(Sample {
            central: central / (2.0 * step),
            jump: jump / step,
            extent: Extent {
                size: f64::sqrt(size),
                weight: f64::sqrt(weights),
            },
        }))
    }

    /// Outputs after `step` times the moves.
    fn at(&mut self, line: &Line, step: f64) -> Result<Vec<f64>, CheckError> {
        let range = line.range.clone();
        let original = &self.inputs.entries[line.input].1.values[range.clone()];
        let moved = &mut self.moved.entries[line.input].1.values[range.clone()];
        for ((moved, x), v) in moved
            .iter_mut()
            .zip(original)
            .zip(&line.moves[range.clone()])
        {
            *moved = x + step * v;
        }
        let outputs = self.function.outputs(&self.moved);
        self.moved.entries[line.input].1.values[range].copy_from_slice(original);
        let mut values: Vec<f64> = Vec::with_capacity(self.middle.len());
        for output in outputs? {
            values.extend(output.values);
        }
        if values.len() == self.middle.len() {
            return Ok(values);
        }
        Err(CheckError::Outputs(format!(
            "{} elements at the inputs and {} beside them: their number must not depend on values",
            self.middle.len(),
            values.len()
        )))
    }
}

/// Size of each element, as a power of two, so that steps are exact.
///
/// The size of an element near zero is a hundredth of the others' median.
pub(super) fn sizes(values: &[f64]) -> Vec<f64> {
    let mut lengths: Vec<f64> = values
        .iter()
        .map(|x| x.abs())
        .filter(|x| *x > 0.0)
        .collect();
    let middle = lengths.len() / 2;
    let median = match lengths.is_empty() {
        true => 100.0,
        false => *lengths.select_nth_unstable_by(middle, f64::total_cmp).1,
    };
    values
        .iter()
        .map(|x| x.abs().max(0.01 * median).log2().floor().exp2())
        .collect()
}
