//! Histograms as text.

/// Width of the longest bar in characters.
const BAR: usize = 40;

/// A histogram of `values` over `bins` equal bins of `[start, end]`; values outside count into the
/// first and last bin. One line per bin: its range, a bar, its share.
pub(super) fn histogram(
    values: impl Iterator<Item = f64>,
    start: f64,
    end: f64,
    bins: usize,
) -> String {
    let mut counts = vec![0usize; bins];
    for value in values {
        let at = (value - start) / (end - start) * bins as f64;
        // The cast saturates, so that everything below the first bin is counted there.
        counts[(at as usize).min(bins - 1)] += 1;
    }
    let total: usize = counts.iter().sum();
    let most = counts.iter().copied().max().unwrap_or(0).max(1);
    let width = (end - start) / bins as f64;
    let line = |(bin, &count): (usize, &usize)| {
        let from = start + bin as f64 * width;
        let bar = "#".repeat((count * BAR).div_ceil(most));
        let share = 100.0 * count as f64 / total.max(1) as f64;
        format!(
            "  {from:6.2} to {:6.2}  {bar:BAR$}  {share:5.1} %\n",
            from + width
        )
    };
    counts.iter().enumerate().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_is_counted_once() {
        let text = histogram([-5.0, 0.1, 0.6, 1.0, 9.0].into_iter(), 0.0, 1.0, 2);
        let lines: Vec<&str> = text.lines().collect();
        assert!(lines[0].starts_with("    0.00 to   0.50  ") && lines[0].ends_with(" 40.0 %"));
        assert!(lines[1].starts_with("    0.50 to   1.00  ") && lines[1].ends_with(" 60.0 %"));
        assert_eq!(lines[0].matches('#').count(), 27);
        assert_eq!(lines[1].matches('#').count(), BAR);
        assert!(histogram([].into_iter(), 0.0, 1.0, 1).ends_with("0.0 %\n"));
    }
}
