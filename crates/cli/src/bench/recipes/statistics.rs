//! Means of repeated measurements.

use std::fmt;

/// A mean with its standard error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Mean {
    /// The mean.
    pub mean: f64,
    /// Standard error of the mean, from the standard deviation over n - 1; `None` of a single
    /// value.
    pub error: Option<f64>,
}

impl Mean {
    /// The mean of values; NaN if there are none.
    pub(super) fn of(values: &[f64]) -> Self {
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let squares = values.iter().map(|value| (value - mean).powi(2));
        let variance = squares.sum::<f64>() / (count - 1.0);
        Self {
            mean,
            error: (values.len() > 1).then(|| (variance / count).sqrt()),
        }
    }

    /// The mean with so many decimals, its error beside it.
    pub(super) fn with(self, decimals: usize) -> Shown {
        Shown {
            value: self,
            decimals,
            signed: false,
        }
    }

    /// [`with`](Self::with) the sign of a difference.
    pub(super) fn signed(self, decimals: usize) -> Shown {
        Shown {
            signed: true,
            ..self.with(decimals)
        }
    }
}

/// A mean as text: `24.31 ± 0.02`.
pub(super) struct Shown {
    value: Mean,
    decimals: usize,
    signed: bool,
}

impl fmt::Display for Shown {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Mean { mean, error }, decimals) = (self.value, self.decimals);
        match self.signed {
            true => write!(f, "{mean:+.decimals$}")?,
            false => write!(f, "{mean:.decimals$}")?,
        }
        match error {
            Some(error) => write!(f, " ± {error:.decimals$}"),
            None => Ok(()),
        }
    }
}

/// The geometric mean of ratios, for which half and double cancel; NaN if there are none.
pub(super) fn geometric(ratios: &[f64]) -> f64 {
    let logarithms = ratios.iter().map(|ratio| ratio.ln());
    (logarithms.sum::<f64>() / ratios.len() as f64).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_error_is_that_of_the_mean() {
        let mean = Mean::of(&[2.0, 4.0, 6.0]);
        assert_eq!(mean.mean, 4.0);
        // The standard deviation is 2.
        assert!((mean.error.unwrap() - 2.0 / 3.0_f64.sqrt()).abs() < 1e-15);
        assert_eq!(mean.with(2).to_string(), "4.00 ± 1.15");
        assert_eq!(mean.signed(1).to_string(), "+4.0 ± 1.2");
        let one = Mean::of(&[-0.5]);
        assert_eq!((one.mean, one.error), (-0.5, None));
        assert_eq!(one.signed(1).to_string(), "-0.5");
        assert!(Mean::of(&[]).mean.is_nan());
        assert_eq!(Mean::of(&[]).error, None);
    }

    #[test]
    fn half_and_double_cancel() {
        assert!((geometric(&[0.5, 2.0]) - 1.0).abs() < 1e-15);
        assert!((geometric(&[3.0]) - 3.0).abs() < 1e-15);
        assert!(geometric(&[]).is_nan());
    }
}
