//! Derivative along one line, from differences at decreasing steps.
//!
//! Each step is a quarter of the previous one. Richardson's extrapolation removes the powers of the
//! step from the differences, and the tableau value with the smallest estimated error is kept
//! (Ridders 1982). Large steps are exact for smooth functions; near a kink only small ones remain.

use super::noise::Noise;
use super::sample::{Extent, LEVELS, RATIO, Sample};

/// Rows of the tableau before it is trusted.
const LEAST: usize = 3;

/// A value with its error bound.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Estimate {
    pub value: f64,
    pub error: f64,
}

/// The derivative along a line.
#[derive(Debug, Clone, Copy)]
pub(super) struct Slope {
    pub central: Estimate,
    /// Slope on the right minus slope on the left, as the step goes to zero.
    pub jump: Estimate,
    /// Upper bound of the size of the values that changed.
    pub size: f64,
}

/// Errors below which smaller steps are not worthwhile.
#[derive(Debug, Clone, Copy)]
pub(super) struct Enough {
    pub central: f64,
    pub jump: f64,
}

/// Decreases the step from `first` until the errors are `enough`, or as small as rounding allows.
/// `None` if no two consecutive steps are usable, for which `sample` returns `None`.
pub(super) fn climb_down<E>(
    first: f64,
    noise: Noise,
    enough: Enough,
    mut sample: impl FnMut(f64) -> Result<Option<Sample>, E>,
) -> Result<Option<Slope>, E> {
    // Even powers of the step for one, odd powers for the other.
    let mut central = Tableau::new(RATIO * RATIO);
    let mut jump = Tableau::new(RATIO);
    let mut extent = Extent::default();
    let mut step = first;
    for _ in 0..LEVELS {
        match sample(step)? {
            None => {
                central.restart();
                jump.restart();
            }
            Some(at) => {
                extent = extent.or(at.extent);
                let noise = noise.of(extent) / step;
                central.push(at.central, noise);
                jump.push(at.jump, 4.0 * noise);
                let done = central.is_within(enough.central)
                    && jump.is_within(enough.jump)
                    && jump.best.value.abs() <= enough.jump.max(4.0 * jump.best.error);
                if done {
                    break;
                }
            }
        }
        step /= RATIO;
    }
    let found = central.best.error.is_finite() && jump.best.error.is_finite();
    Ok(found.then_some(Slope {
        central: central.best,
        jump: jump.best,
        size: extent.size,
    }))
}

/// Rows of Richardson's extrapolation; only the last is kept.
struct Tableau {
    /// Factor by which the first eliminated power of the step falls from row to row.
    falls: f64,
    row: Vec<f64>,
    rows: usize,
    best: Estimate,
    /// Rounding error of `best`.
    noise: f64,
}

impl Tableau {
    fn new(falls: f64) -> Self {
        Self {
            falls,
            row: Vec::new(),
            rows: 0,
            best: Estimate {
                value: f64::NAN,
                error: f64::INFINITY,
            },
            noise: 0.0,
        }
    }

    fn restart(&mut self) {
        self.row.clear();
        self.rows = 0;
    }

    fn push(&mut self, value: f64, noise: f64) {
        let mut next = vec![value];
        let mut falls = self.falls;
        for (column, before) in std::mem::take(&mut self.row).into_iter().enumerate() {
            let last = next[column];
            let value = last + (last - before) / (falls - 1.0);
            // The first difference is between two steps; later ones are between extrapolations,
            // too.
            let differs = match column {
                0 => f64::INFINITY,
                _ => (value - last).abs().max((value - before).abs()),
            };
            let plain = (last - before).abs();
            self.offer(last, plain + noise, noise);
            self.offer(value, differs + noise, noise);
            next.push(value);
            falls *= RATIO * RATIO;
        }
        self.row = next;
        self.rows += 1;
    }

    fn offer(&mut self, value: f64, error: f64, noise: f64) {
        if error < self.best.error {
            self.best = Estimate { value, error };
            self.noise = noise;
        }
    }

    fn is_within(&self, enough: f64) -> bool {
        self.rows >= LEAST && self.best.error <= enough.max(3.0 * self.noise)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slope(f: impl Fn(f64) -> f64) -> Slope {
        let enough = Enough {
            central: 1e-12,
            jump: 1e-9,
        };
        climb_down(1.0 / 64.0, Noise::LEAST, enough, |h| {
            let (right, middle, left) = (f(h), f(0.0), f(-h));
            let usable = (right + left).is_finite();
            Ok::<_, std::convert::Infallible>(usable.then(|| Sample {
                central: (right - left) / (2.0 * h),
                jump: (right - 2.0 * middle + left) / h,
                extent: Extent {
                    size: middle.abs(),
                    weight: 1.0,
                },
            }))
        })
        .unwrap()
        .unwrap()
    }

    #[test]
    fn a_smooth_function_is_differentiated_to_rounding() {
        let cases: [(&dyn Fn(f64) -> f64, f64); 4] = [
            (&|x| (x + 0.7).sin(), 0.7f64.cos()),
            (&|x| (3.0 * x).exp(), 3.0),
            (&|x| (x + 0.05).ln(), 20.0),
            (&|x| 1.0 / (1.0 + 25.0 * (x + 0.2).powi(2)), -2.5),
        ];
        for (f, derivative) in cases {
            let slope = slope(f);
            let off = (slope.central.value - derivative).abs();
            assert!(off <= 1e-11 * derivative.abs(), "{slope:?} {derivative}");
            assert!(off <= slope.central.error, "{slope:?} {derivative}");
            assert!(
                slope.jump.value.abs() <= 4.0 * slope.jump.error,
                "{slope:?}"
            );
        }
    }

    #[test]
    fn a_kink_has_its_two_slopes() {
        let slope = slope(|x| if x > 0.0 { x.sin() } else { -3.0 * x });
        assert!((slope.jump.value - 4.0).abs() < 1e-6, "{slope:?}");
        assert!((slope.central.value + 1.0).abs() < 1e-6, "{slope:?}");
        assert!(slope.jump.error < 1e-6, "{slope:?}");
    }

    #[test]
    fn a_kink_beside_the_point_is_no_kink_of_it() {
        for distance in [1e-2, 1e-3, 1e-5, 1e-7] {
            let slope = slope(|x| 2.0 * (x - distance).max(0.0) + (x + 0.3).sin());
            let off = (slope.central.value - 0.3f64.cos()).abs();
            assert!(off <= 10.0 * slope.central.error, "{distance} {slope:?}");
            assert!(off < 1e-6, "{distance} {slope:?}");
            assert!(slope.jump.value.abs() < 1e-6, "{distance} {slope:?}");
        }
    }

    #[test]
    fn a_step_out_of_the_domain_is_not_used() {
        let slope = slope(|x| (x + 1e-3).ln());
        assert!((slope.central.value - 1e3).abs() < 1e-6, "{slope:?}");
    }

    #[test]
    fn a_discontinuity_has_no_small_error() {
        let slope = slope(|x| f64::from(u8::from(x > 0.0)));
        assert!(slope.central.error > 1.0, "{slope:?}");
    }
}
