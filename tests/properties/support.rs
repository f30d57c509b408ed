//! Seeds, tolerances and weights shared by the properties.

use proptest::prelude::*;
use proptest::test_runner::RngSeed;

/// The same cases in every run, without files of past failures; a failure prints its shrunk scene.
pub fn config(cases: u32) -> ProptestConfig {
    ProptestConfig {
        cases,
        rng_seed: RngSeed::Fixed(20),
        failure_persistence: None,
        max_shrink_iters: 500,
        ..ProptestConfig::default()
    }
}

/// Weights of a loss `sum(weights * output)`: of both signs, all different, and unrelated to the
/// scenes.
pub fn weights(count: usize) -> Vec<f64> {
    (0..count).map(|i| (1.7 * i as f64 + 0.3).sin()).collect()
}

pub fn norm(values: &[f64]) -> f64 {
    values.iter().map(|v| v * v).sum::<f64>().sqrt()
}

/// Checks `|a - b| <= tolerance |b|`. NaN fails.
pub fn close(name: &str, a: &[f64], b: &[f64], tolerance: f64) -> Result<(), TestCaseError> {
    prop_assert_eq!(a.len(), b.len(), "lengths of {}", name);
    let difference: Vec<f64> = a.iter().zip(b).map(|(a, b)| a - b).collect();
    let (error, size) = (norm(&difference), norm(b));
    prop_assert!(
        error <= tolerance * size,
        "{name}: off by {error:e} of {size:e}, more than {tolerance:e} of it"
    );
    Ok(())
}

/// Checks for identical bits.
pub fn identical(name: &str, a: &[f64], b: &[f64]) -> Result<(), TestCaseError> {
    prop_assert_eq!(a.len(), b.len(), "lengths of {}", name);
    for (i, (a, b)) in a.iter().zip(b).enumerate() {
        prop_assert!(
            a.to_bits() == b.to_bits(),
            "{name}: entry {i} is {a:e}, not {b:e}"
        );
    }
    Ok(())
}

/// Maps rows of `width` values.
pub fn map_rows<const W: usize>(values: &[f64], map: impl Fn([f64; W]) -> [f64; W]) -> Vec<f64> {
    values
        .as_chunks::<W>()
        .0
        .iter()
        .flat_map(|row| map(*row))
        .collect()
}

/// Rows of `width` values in a new order: row i of the result is row `order[i]`.
pub fn reorder(values: &[f64], width: usize, order: &[usize]) -> Vec<f64> {
    order
        .iter()
        .flat_map(|i| &values[i * width..(i + 1) * width])
        .copied()
        .collect()
}
