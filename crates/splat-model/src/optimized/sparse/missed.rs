//! The steps that rows have missed, and what full Adam would have done in them.
//!
//! Without a gradient, k steps of Adam decay the moments to `b1^k m` and `b2^k v`, and move the
//! parameter by
//!
//! ```text
//! sum over j = 1..k of  rate_j  b1^j m / (b2^(j/2) sqrt(v) + epsilon_j)
//!     = m sum of w_j / (sqrt(v) + e_j),    w_j = rate_j (b1/sqrt(b2))^j,  e_j = epsilon_j b2^(-j/2)
//!     ~ m (sum of w_j) / (sqrt(v) + e),    e = (sum of w_j e_j) / (sum of w_j)
//! ```
//!
//! with the rates and bias corrections of each step as they were. The last line is exact where
//! epsilon is nothing beside sqrt(v), and exact to second order in the spread of the e_j elsewhere.
//! What remains is rounding: k steps round the parameter k times, one sum once.

use std::collections::BTreeMap;

use burn::tensor::TensorData;
use splat_ops::{AdamGap, AdamRows, AdamStep};

use crate::optimizer::{SplatAdam, StateRecord};

/// The steps since all rows were caught up, by field.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct MissedSteps {
    /// Number of steps.
    steps: usize,
    /// Learning rate at each step; negative where the field took none. In single precision, so that
    /// a checkpoint keeps them.
    rates: BTreeMap<String, Vec<f32>>,
}

/// Rate of a step that a field did not take.
const NO_STEP: f32 = -1.0;

impl MissedSteps {
    pub(super) fn len(&self) -> usize {
        self.steps
    }

    /// Notes a step, with the rates of the fields that took it.
    pub(super) fn push(&mut self, rates: &BTreeMap<String, f64>) {
        for (name, rate) in rates {
            let own = self.rates.entry(name.clone()).or_default();
            own.resize(self.steps, NO_STEP);
            own.push(*rate as f32);
        }
        self.steps += 1;
    }

    /// For a field that has taken `time` steps in all: by number of the last step here that a row
    /// took part in, what it has missed since. The last one has missed nothing.
    pub(super) fn of_field(&self, field: &str, adam: &SplatAdam, time: usize) -> Vec<Missed> {
        let mut sums = Sums::default();
        let none = Missed {
            gap: sums.finish(),
            last_rate: 0.0,
        };
        let mut missed = vec![none; self.steps + 1];
        let rates = self.rates.get(field).map_or(&[][..], Vec::as_slice);
        let mut time = time;
        for step in (0..self.steps).rev() {
            let rate = rates.get(step).copied().unwrap_or(NO_STEP);
            if rate >= 0.0 {
                let taken = adam.step_at(f64::from(rate), time);
                missed[step + 1].last_rate = taken.rate;
                if adam.rows == AdamRows::All {
                    sums = sums.before(&taken);
                }
                time = time.saturating_sub(1);
            }
            missed[step].gap = sums.finish();
        }
        missed
    }

    pub(super) fn save(&self) -> StateRecord {
        let mut record = StateRecord::default();
        for (name, rates) in &self.rates {
            let mut rates = rates.clone();
            rates.resize(self.steps, NO_STEP);
            let data = TensorData::new(rates, [self.steps]);
            record.tensors.insert(name.clone(), data);
        }
        record
    }

    /// Puts back what [`save`](Self::save) gave.
    pub(super) fn restore(record: StateRecord, steps: usize) -> Result<Self, String> {
        let mut rates = BTreeMap::new();
        for (name, data) in record.tensors {
            let values = data.convert::<f32>().try_into_vec::<f32>();
            match values {
                Ok(values) if values.len() == steps => rates.insert(name, values),
                _ => return Err(format!("the missed steps of `{name}` are not {steps}")),
            };
        }
        Ok(Self { steps, rates })
    }
}

/// What a row has missed since its last step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Missed {
    pub(super) gap: AdamGap,
    /// Rate of the row's last step, bias corrections included.
    last_rate: f64,
}

impl Missed {
    /// Furthest that a value may have come since before its last step, whatever its gradient was:
    /// by Cauchy and Schwarz, `|m| / sqrt(v)` is at most `(1 - b1) / sqrt((1 - b2) (1 - b1^2/b2))`,
    /// 7.3 for the usual betas.
    pub(super) fn drift(&self, adam: &SplatAdam) -> f64 {
        farthest(adam) * (self.last_rate + self.gap.step)
    }
}

/// Largest `|m| / sqrt(v)`.
pub(super) fn farthest(adam: &SplatAdam) -> f64 {
    let ratio = adam.beta_1 * adam.beta_1 / adam.beta_2;
    (1.0 - adam.beta_1) / ((1.0 - adam.beta_2) * (1.0 - ratio)).sqrt()
}

/// Sums over the steps of a gap.
#[derive(Debug, Clone, Copy)]
struct Sums {
    keep_1: f64,
    keep_2: f64,
    /// Of w_j, and of w_j e_j.
    step: f64,
    epsilon: f64,
}

impl Default for Sums {
    fn default() -> Self {
        Self {
            keep_1: 1.0,
            keep_2: 1.0,
            step: 0.0,
            epsilon: 0.0,
        }
    }
}

impl Sums {
    /// The sums with one step more at the beginning.
    fn before(self, step: &AdamStep) -> Self {
        let root = step.beta_2.sqrt();
        let decay = step.beta_1 / root;
        Self {
            keep_1: self.keep_1 * step.beta_1,
            keep_2: self.keep_2 * step.beta_2,
            step: decay * (step.rate + self.step),
            epsilon: decay / root * (step.rate * step.epsilon + self.epsilon),
        }
    }

    fn finish(self) -> AdamGap {
        if !(self.step > 0.0) {
            return AdamGap {
                keep_1: self.keep_1,
                keep_2: self.keep_2,
                ..AdamGap::NONE
            };
        }
        AdamGap {
            keep_1: self.keep_1,
            keep_2: self.keep_2,
            step: self.step,
            epsilon: self.epsilon / self.step,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What single steps without a gradient do to (p, m, v), in double precision.
    fn stepped(
        [mut p, mut m, mut v]: [f64; 3],
        adam: &SplatAdam,
        rates: &[f32],
        mut time: usize,
    ) -> [f64; 3] {
        for rate in rates.iter().filter(|rate| **rate >= 0.0) {
            time += 1;
            let step = adam.step_at(f64::from(*rate), time);
            m *= step.beta_1;
            v *= step.beta_2;
            p -= step.rate * m / (v.sqrt() + step.epsilon);
        }
        [p, m, v]
    }

    fn caught_up([p, m, v]: [f64; 3], gap: &AdamGap) -> [f64; 3] {
        let drift = gap.step * m / (v.sqrt() + gap.epsilon);
        [p - drift, m * gap.keep_1, v * gap.keep_2]
    }

    /// A schedule that decays, with steps that the field did not take, from time 3 on.
    fn missed(steps: usize) -> (MissedSteps, Vec<f32>) {
        let mut missed = MissedSteps::default();
        let rates: Vec<f32> = (0..steps)
            .map(|step| match step % 5 {
                3 => NO_STEP,
                _ => 0.01 * 0.97f32.powi(step as i32),
            })
            .collect();
        for rate in &rates {
            let rate = (*rate >= 0.0).then(|| ("means".to_owned(), f64::from(*rate)));
            missed.push(&rate.into_iter().collect());
        }
        (missed, rates)
    }

    #[test]
    fn one_sum_is_as_good_as_single_steps() {
        const BEFORE: usize = 3;
        let adam = SplatAdam::new();
        for steps in [1, 2, 7, 40, 900] {
            let (missed, rates) = missed(steps);
            let taken = rates.iter().filter(|rate| **rate >= 0.0).count();
            let gaps = missed.of_field("means", &adam, BEFORE + taken);
            for first in [0, 1, 3, steps / 2, steps].map(|first| first.min(steps)) {
                let time = BEFORE + rates[..first].iter().filter(|rate| **rate >= 0.0).count();
                let start = [0.5, 0.3, 1e-4];
                let expected = stepped(start, &adam, &rates[first..], time);
                let found = caught_up(start, &gaps[first].gap);
                for (found, expected) in found.iter().zip(expected) {
                    assert!(
                        (found - expected).abs() <= 1e-12 * expected.abs(),
                        "{steps} from {first}: {found} {expected}"
                    );
                }
            }
        }
    }

    /// Where epsilon is as large as the root of the second moment, the sum is off by the square of
    /// the spread of what is added to the root, and right again where it is far larger.
    #[test]
    fn epsilon_is_in_the_sum_too() {
        let (missed, rates) = missed(40);
        let taken = rates.iter().filter(|rate| **rate >= 0.0).count();
        for (root, most) in [(1e-3, 0.15), (1.0, 5e-3), (1e3, 1e-6)] {
            let adam = SplatAdam {
                epsilon: 1.0,
                ..SplatAdam::new()
            };
            let gaps = missed.of_field("means", &adam, 3 + taken);
            let start = [0.0, root, root * root];
            let [expected, ..] = stepped(start, &adam, &rates, 3);
            let [found, ..] = caught_up(start, &gaps[0].gap);
            let error = (found / expected - 1.0).abs();
            assert!(error < most, "root {root}: {found} {expected}, {error:e}");
        }
    }

    #[test]
    fn no_gradient_takes_a_value_further_than_the_bound() {
        let adam = SplatAdam::new();
        // The worst: nothing for long, then one large gradient.
        let (mut m, mut v) = (0.0, 0.0);
        for _ in 0..5 {
            m = m * adam.beta_1 + (1.0 - adam.beta_1) * 1e-9;
            v = v * adam.beta_2 + (1.0 - adam.beta_2) * 1e-18;
        }
        let gradients = (0..200).map(|i| (adam.beta_1 / adam.beta_2).powi(200 - i));
        for gradient in gradients {
            m = m * adam.beta_1 + (1.0 - adam.beta_1) * gradient;
            v = v * adam.beta_2 + (1.0 - adam.beta_2) * gradient * gradient;
        }
        let reached = m / f64::sqrt(v);
        let bound = farthest(&adam);
        assert!((7.2..7.3).contains(&bound), "{bound}");
        assert!(reached <= bound && reached > 0.99 * bound, "{reached}");
    }

    #[test]
    fn rows_that_only_step_when_seen_miss_nothing() {
        let adam = SplatAdam {
            rows: AdamRows::Seen,
            ..SplatAdam::new()
        };
        let (missed, _) = missed(7);
        let gaps = missed.of_field("means", &adam, 7);
        assert!(gaps.iter().all(|missed| missed.gap == AdamGap::NONE));
    }

    #[test]
    fn a_checkpoint_keeps_it_to_the_bit() {
        let (missed, _) = missed(7);
        assert_eq!(MissedSteps::restore(missed.save(), 7), Ok(missed.clone()));
        assert!(MissedSteps::restore(missed.save(), 6).is_err());
    }
}
