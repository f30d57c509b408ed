//! Roots of polynomials, in double precision. Coefficients begin with the constant.

/// Value at `x`.
pub(super) fn value(coefficients: &[f64], x: f64) -> f64 {
    coefficients.iter().rev().fold(0.0, |sum, c| sum * x + c)
}

/// Coefficients of the derivative.
pub(super) fn derivative(coefficients: &[f64]) -> Vec<f64> {
    let rest = coefficients.iter().enumerate().skip(1);
    rest.map(|(power, c)| power as f64 * c).collect()
}

/// Coefficients of the product.
pub(super) fn product(a: &[f64], b: &[f64]) -> Vec<f64> {
    let mut sums = vec![0.0; a.len() + b.len() - 1];
    for (i, x) in a.iter().enumerate() {
        for (j, y) in b.iter().enumerate() {
            sums[i + j] += x * y;
        }
    }
    sums
}

/// The smallest root above 0 and up to `end` at which the sign changes.
pub(super) fn first_root(coefficients: &[f64], end: f64) -> Option<f64> {
    roots(coefficients, end).first().copied()
}

/// All roots above 0 and up to `end` at which the sign changes, in order. Between two neighbouring
/// roots of its derivative a polynomial is monotonic, and bisection finds the root that is there.
fn roots(coefficients: &[f64], end: f64) -> Vec<f64> {
    if coefficients.len() < 2 {
        return Vec::new();
    }
    let mut bounds = vec![0.0];
    bounds.extend(roots(&derivative(coefficients), end));
    bounds.push(end);
    let between = bounds.windows(2);
    between
        .filter_map(|bounds| crossing(|x| value(coefficients, x), bounds[0], bounds[1]))
        .collect()
}

/// Where a function that is monotonic from `low` to `high` changes its sign.
pub(super) fn crossing(f: impl Fn(f64) -> f64, mut low: f64, mut high: f64) -> Option<f64> {
    let (at_low, at_high) = (f(low), f(high));
    // The end belongs to an interval, the start to the one before it.
    if at_high == 0.0 {
        return Some(high);
    }
    if at_low == 0.0 || (at_low > 0.0) == (at_high > 0.0) || !(at_low + at_high).is_finite() {
        return None;
    }
    loop {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            return Some(middle);
        }
        if (f(middle) > 0.0) == (at_low > 0.0) {
            low = middle;
        } else {
            high = middle;
        }
    }
}
