//! Quantiles of values.

/// The middle value, the upper of two; NaN if empty.
pub(crate) fn median(values: impl IntoIterator<Item = f64>) -> f64 {
    quantile(values, 0.5)
}

/// The value at a quantile; NaN if empty.
pub(crate) fn quantile(values: impl IntoIterator<Item = f64>, share: f64) -> f64 {
    let mut values: Vec<f64> = values.into_iter().collect();
    if values.is_empty() {
        return f64::NAN;
    }
    let index = ((values.len() as f64 * share) as usize).min(values.len() - 1);
    *values.select_nth_unstable_by(index, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_values_of_the_list() {
        let values = [5.0, 1.0, 3.0, 2.0];
        assert_eq!((median(values), quantile(values, 0.0)), (3.0, 1.0));
        assert_eq!(quantile(values, 1.0), 5.0);
        assert!(median([]).is_nan());
    }
}
