//! The gradient check of any function: what it finds, what it passes, and PyTorch's verdict on the
//! same functions.
//!
//! - `ten`: ten functions, compared with `torch.autograd.gradcheck`.
//! - `planted`: bugs of every kind, found and named.
//! - `million`: large inputs, and the smallest error seen in them.
//! - `right`: functions with correct gradients pass, including our own ops.
//! - `fixtures`: fixtures of `scripts/fixtures.py`.
//! - `refused`: functions that cannot be checked, and the messages.
#![cfg(feature = "cpu")]

mod fixtures;
mod million;
mod planted;
mod refused;
mod right;
mod ten;

use burn::tensor::Tensor;
use splat_lab::central::{Finding, Kind, Report, tensor};

/// Arbitrary numbers from -1 to 1.
pub fn numbers(seed: u64, count: usize) -> Vec<f64> {
    let mut state = seed.wrapping_mul(2).wrapping_add(1);
    let mut next = || {
        state = state
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    };
    (0..count + 4).map(|_| next()).skip(4).collect()
}

/// A tensor of arbitrary numbers.
pub fn random<const D: usize>(seed: u64, shape: [usize; D]) -> Tensor<D> {
    tensor(numbers(seed, shape.iter().product()), shape)
}

/// The only finding of an input.
pub fn only(report: &Report, input: &str) -> Finding {
    let row = report.row(input).expect("an input of that name");
    assert_eq!(row.findings.len(), 1, "{report}");
    row.findings[0].clone()
}

/// Asserts that the input's only finding is a wrong derivative at an element.
pub fn assert_wrong(report: &Report, input: &str, at: &[usize]) {
    let finding = only(report, input);
    assert_eq!(finding.kind, Kind::Wrong, "{report}");
    assert_eq!(finding.comparison.at.as_deref(), Some(at), "{report}");
}
