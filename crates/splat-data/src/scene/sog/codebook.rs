//! Codebooks: up to 256 numbers that stand for many.

use rayon::prelude::*;

/// Most entries of a codebook.
const MOST: usize = 256;
/// Bins of the density from which the entries start.
const BINS: usize = 4_096;
/// Most rounds of Lloyd's algorithm; the error hardly changes after some.
const ROUNDS: usize = 40;

/// Ascending numbers with a small mean squared distance to the nearest for all `values`, which are
/// finite: Lloyd's algorithm, from the density that is best for many entries, the cube root of that
/// of the values (Panter and Dite 1951).
pub(super) fn fit(mut values: Vec<f32>) -> Vec<f32> {
    values.par_sort_unstable_by(f32::total_cmp);
    let mut distinct = values.clone();
    distinct.dedup();
    if distinct.len() <= MOST {
        return distinct;
    }
    drop(distinct);
    // Sums of all values before each, for means of ranges.
    let mut sums = Vec::with_capacity(values.len() + 1);
    sums.push(0.0);
    let mut sum = 0.0;
    for &value in &values {
        sum += f64::from(value);
        sums.push(sum);
    }
    let mut entries = start(&values);
    for _ in 0..ROUNDS {
        let mut next = Vec::with_capacity(entries.len());
        let mut begin = 0;
        for at in 0..entries.len() {
            let end = match entries.get(at + 1) {
                Some(after) => {
                    let middle = 0.5 * (entries[at] + after);
                    begin + values[begin..].partition_point(|&value| f64::from(value) < middle)
                }
                None => values.len(),
            };
            // An entry that no value is nearest to is given up.
            if end > begin {
                next.push((sums[end] - sums[begin]) / (end - begin) as f64);
            }
            begin = end;
        }
        if next == entries {
            break;
        }
        entries = next;
    }
    let mut entries: Vec<f32> = entries.into_iter().map(|entry| entry as f32).collect();
    entries.dedup();
    entries
}

/// First entries for sorted values of some range.
fn start(values: &[f32]) -> Vec<f64> {
    let (least, most) = (f64::from(values[0]), f64::from(values[values.len() - 1]));
    let width = (most - least) / BINS as f64;
    let mut counts = vec![0u64; BINS];
    for &value in values {
        let bin = ((f64::from(value) - least) / width) as usize;
        counts[bin.min(BINS - 1)] += 1;
    }
    let densities: Vec<f64> = counts.iter().map(|&count| (count as f64).cbrt()).collect();
    let total: f64 = densities.iter().sum();
    let mut entries = Vec::with_capacity(MOST);
    let mut before = 0.0;
    for (bin, density) in densities.iter().enumerate() {
        // Entry i stands in the middle of the i-th of equal shares of the density.
        while entries.len() < MOST {
            let share = (entries.len() as f64 + 0.5) / MOST as f64 * total;
            if share > before + density {
                break;
            }
            let within = if *density > 0.0 {
                (share - before) / density
            } else {
                0.5
            };
            entries.push(least + (bin as f64 + within) * width);
        }
        before += density;
    }
    entries
}

/// A codebook of 256 entries, as readers expect; the last one is repeated.
pub(super) fn full(mut codebook: Vec<f32>) -> Vec<f32> {
    let last = codebook.last().copied().unwrap_or_default();
    codebook.resize(MOST, last);
    codebook
}

/// Search for the nearest entry.
pub(super) struct Codes {
    /// Middle between each entry and the next.
    middles: Vec<f32>,
}

impl Codes {
    pub fn new(codebook: &[f32]) -> Self {
        let middle = |pair: &[f32]| (0.5 * (f64::from(pair[0]) + f64::from(pair[1]))) as f32;
        Self {
            middles: codebook.windows(2).map(middle).collect(),
        }
    }

    /// Code of the entry nearest to a value.
    pub fn nearest(&self, value: f32) -> u8 {
        self.middles.partition_point(|&middle| middle < value) as u8
    }
}

/// The value of a code, or the reason why there is none.
pub(super) fn value(codebook: &[Option<f32>], code: u8) -> Result<f32, String> {
    match codebook.get(usize::from(code)) {
        Some(Some(value)) if value.is_finite() => Ok(*value),
        Some(_) => Err(format!("entry {code} of the codebook is no finite number")),
        None => Err(format!(
            "entry {code} of a codebook of {}; the file is damaged",
            codebook.len()
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mean_squared_error(values: &[f32], codebook: &[f32]) -> f64 {
        let codes = Codes::new(codebook);
        let error = |&value: &f32| {
            let found = codebook[usize::from(codes.nearest(value))];
            // No other entry is nearer.
            let least = codebook.iter().map(|entry| (entry - value).abs());
            let least = least.fold(f32::INFINITY, f32::min);
            assert!((found - value).abs() <= least + 1e-6);
            f64::from(found - value).powi(2)
        };
        values.iter().map(error).sum::<f64>() / values.len() as f64
    }

    #[test]
    fn few_values_are_exact() {
        let codebook = fit(vec![3.0, -1.0, 3.0, 0.5]);
        assert_eq!(codebook, [-1.0, 0.5, 3.0]);
        assert_eq!(full(codebook.clone())[2..], [3.0; 254]);
        assert_eq!(mean_squared_error(&[3.0, -1.0, 0.5], &codebook), 0.0);
        assert!(value(&[Some(1.0), None], 1).is_err() && value(&[], 0).is_err());
    }

    /// On a bell curve the best 256 entries have an error of about sqrt(3) pi / 2 / 256^2 (Panter
    /// and Dite), a third of that of equal steps over six standard deviations.
    #[test]
    fn many_values_are_nearly_best() {
        let value = |i: usize| {
            let uniform = |salt: usize| {
                let bits = (i * 8 + salt).wrapping_mul(0x9e37_79b9_7f4a_7c15);
                ((bits >> 40) as f64 + 0.5) / (1u64 << 24) as f64
            };
            let radius = (-2.0 * uniform(1).ln()).sqrt();
            (radius * (std::f64::consts::TAU * uniform(2)).cos()) as f32
        };
        let values: Vec<f32> = (0..100_000).map(value).collect();
        let codebook = fit(values.clone());
        assert!(codebook.is_sorted() && codebook.len() > 200);
        let error = mean_squared_error(&values, &codebook);
        let best = 3f64.sqrt() * std::f64::consts::PI / 2.0 / 256f64.powi(2);
        assert!(error < 1.15 * best, "{error} {best}");
    }
}
