//! Adam (Kingma & Ba 2015) in one pass over memory.

use burn::optim::{LearningRate, Optimizer, RecordState, StateSink, StateSource};
use burn::tensor::{Device, Tensor};
use splat_data::SceneScale;
use splat_ops::{AdamRows, AdamStep, adam_step};

use super::edit::{MomentEdit, RowOptimizer};
use crate::Field;

/// Adam for one field of a model.
///
/// A gradient entry whose square is not finite counts as zero, as if the view had not seen that
/// Gaussian. In the moments it would persist and make the parameter NaN, or freeze it.
#[derive(Debug, Clone)]
pub struct SplatAdam {
    /// Decay of the first moment.
    pub beta_1: f64,
    /// Decay of the second moment.
    pub beta_2: f64,
    /// Added to the root of the second moment.
    pub epsilon: f64,
    /// Rows that take a step. [`AdamRows::Seen`] is another optimiser with other results; measure
    /// before relying on it.
    pub rows: AdamRows,
}

impl Default for SplatAdam {
    fn default() -> Self {
        Self::new()
    }
}

impl SplatAdam {
    /// The settings of 3DGS: betas 0.9 and 0.999, epsilon 1e-15, all rows.
    pub fn new() -> Self {
        Self {
            beta_1: 0.9,
            beta_2: 0.999,
            epsilon: 1e-15,
            rows: AdamRows::All,
        }
    }

    /// Settings for a field, stepping `rows`. If the field's values are lengths, epsilon (one over
    /// a length) follows the size of the scene.
    pub fn of_field(field: &Field, rows: AdamRows, scene: SceneScale) -> Self {
        let mut adam = Self::new();
        adam.rows = rows;
        if field.is_length {
            adam.epsilon = scene.means_epsilon();
        }
        adam
    }

    /// The constants of step number `time`, counted from 1.
    pub(crate) fn step_at(&self, rate: f64, time: usize) -> AdamStep {
        let time = time as f64;
        let correction_1 = 1.0 - self.beta_1.powf(time);
        let correction_2 = (1.0 - self.beta_2.powf(time)).sqrt();
        // m / c1 / (sqrt(v) / c2 + eps) = (c2 / c1) m / (sqrt(v) + c2 eps)
        AdamStep {
            beta_1: self.beta_1,
            beta_2: self.beta_2,
            rate: rate * correction_2 / correction_1,
            epsilon: self.epsilon * correction_2,
            rows: self.rows,
        }
    }
}

/// Moments of one parameter.
#[derive(Debug, Clone)]
pub struct SplatAdamState<const D: usize> {
    /// Steps taken.
    pub time: usize,
    /// First moment, of the parameter's shape.
    pub moment_1: Tensor<D>,
    /// Second moment, of the parameter's shape.
    pub moment_2: Tensor<D>,
}

// Implemented by hand, as the derive names crates that only Burn depends on.
impl<const D: usize> RecordState for SplatAdamState<D> {
    fn state_flatten(&self, prefix: &str, out: &mut StateSink) {
        out.push_scalar(prefix, "time", self.time.into());
        out.push_tensor(prefix, "moment_1", self.moment_1.to_data());
        out.push_tensor(prefix, "moment_2", self.moment_2.to_data());
    }

    fn state_unflatten(prefix: &str, src: &mut StateSource, device: &Device) -> Option<Self> {
        Some(Self {
            time: usize::try_from(src.take_scalar(prefix, "time")?).ok()?,
            moment_1: Tensor::from_data(src.take_tensor(prefix, "moment_1")?, device),
            moment_2: Tensor::from_data(src.take_tensor(prefix, "moment_2")?, device),
        })
    }
}

impl Optimizer for SplatAdam {
    type State<const D: usize> = SplatAdamState<D>;

    fn step<const D: usize>(
        &self,
        lr: LearningRate,
        tensor: Tensor<D>,
        grad: Tensor<D>,
        state: Option<Self::State<D>>,
    ) -> (Tensor<D>, Option<Self::State<D>>) {
        let mut state = state.unwrap_or_else(|| SplatAdamState {
            time: 0,
            moment_1: grad.zeros_like(),
            moment_2: grad.zeros_like(),
        });
        state.time += 1;
        let step = self.step_at(lr, state.time);
        let moments = [state.moment_1, state.moment_2];
        let (tensor, [moment_1, moment_2]) = adam_step(tensor, grad, moments, &step).expect(
            "a gradient has the shape of its parameter, and so have the moments made from it",
        );
        state.moment_1 = moment_1;
        state.moment_2 = moment_2;
        (tensor, Some(state))
    }

    fn to_device<const D: usize>(mut state: Self::State<D>, device: &Device) -> Self::State<D> {
        state.moment_1 = state.moment_1.to_device(device);
        state.moment_2 = state.moment_2.to_device(device);
        state
    }
}

impl RowOptimizer for SplatAdam {
    fn edit_rows(state: SplatAdamState<2>, edit: &MomentEdit) -> SplatAdamState<2> {
        SplatAdamState {
            time: state.time,
            moment_1: edit.apply(state.moment_1),
            moment_2: edit.apply(state.moment_2),
        }
    }
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;
    use burn::optim::AdamConfig;
    use burn::tensor::TensorData;

    fn values(tensor: Tensor<2>) -> Vec<f32> {
        tensor.into_data().try_into_vec().unwrap()
    }

    fn gradient(step: usize, device: &Device) -> Tensor<2> {
        let at = |i: f32| (i * 1.7 + step as f32).sin() * 10f32.powf(i - 2.0);
        Tensor::from_floats(
            [[at(0.0), at(1.0)], [at(2.0), at(3.0)], [at(0.5), at(1.5)]],
            device,
        )
    }

    #[test]
    fn the_numbers_are_those_of_burns_adam() {
        let device = Device::flex();
        let theirs = AdamConfig::new().with_epsilon(1e-15).build();
        let ours = SplatAdam::new();
        let start = Tensor::<2>::from_floats([[1.0, -2.0], [0.5, 3.0], [0.0, 0.1]], &device);
        let (mut a, mut b) = (start.clone(), start);
        let (mut state_a, mut state_b) = (None, None);
        for step in 0..50 {
            (a, state_a) = ours.step(0.01, a, gradient(step, &device), state_a);
            (b, state_b) = theirs.step(0.01, b, gradient(step, &device), state_b);
        }
        for (a, b) in values(a).into_iter().zip(values(b)) {
            assert!((a - b).abs() <= 1e-6 * b.abs().max(1.0), "{a} {b}");
        }
    }

    /// Unseen rows are unaffected by a step, except for the step count; seen rows step as usual.
    #[test]
    fn of_seen_rows_only_the_others_keep_everything() {
        let device = Device::flex();
        let mut adam = SplatAdam::new();
        adam.rows = AdamRows::Seen;
        let all = SplatAdam::new();
        let start = Tensor::<2>::from_floats([[1.0, -2.0], [0.5, 3.0], [0.0, 0.1]], &device);
        let (first, state) = adam.step(0.01, start.clone(), gradient(0, &device), None);
        let (same, _) = all.step(0.01, start, gradient(0, &device), None);
        assert_eq!(values(first.clone()), values(same));

        let moments = |state: &Option<SplatAdamState<2>>| {
            let state = state.clone().unwrap();
            [values(state.moment_1), values(state.moment_2)]
        };
        let before = (values(first.clone()), moments(&state));
        // No gradient, one of two elements, and only NaN.
        let gradient = Tensor::from_floats([[0.0, 0.0], [0.0, 0.3], [0.0, f32::NAN]], &device);
        let (seen, seen_state) = adam.step(0.01, first.clone(), gradient.clone(), state.clone());
        let (every, every_state) = all.step(0.01, first, gradient, state);
        let seen = (values(seen), moments(&seen_state));
        let every = (values(every), moments(&every_state));
        let columns =
            |of: &(Vec<f32>, [Vec<f32>; 2])| [of.0.clone(), of.1[0].clone(), of.1[1].clone()];
        for ((seen, before), every) in columns(&seen)
            .iter()
            .zip(columns(&before))
            .zip(columns(&every))
        {
            assert_eq!(seen[..2], before[..2]);
            assert_eq!(seen[2..4], every[2..4]);
            assert_eq!(seen[4..], before[4..]);
            assert_ne!(every[..2], before[..2]);
        }
    }

    #[test]
    fn gradients_that_are_not_finite_leave_no_trace() {
        let device = Device::flex();
        let adam = SplatAdam::new();
        let start = Tensor::<2>::from_floats([[1.0, -2.0], [0.5, 3.0], [0.0, 0.1]], &device);
        let spoiled = [
            (0, f32::NAN),
            (1, f32::INFINITY),
            (2, f32::NEG_INFINITY),
            (3, 1e20),
        ];
        let run = |spoil: &dyn Fn(usize, &mut [f32])| {
            let (mut tensor, mut state) = (start.clone(), None);
            for step in 0..20 {
                let mut grad = values(gradient(step, &device));
                spoil(step, &mut grad);
                let grad = Tensor::from_data(TensorData::new(grad, [3, 2]), &device);
                (tensor, state) = adam.step(0.01, tensor, grad, state);
            }
            values(tensor)
        };
        let with = |value: fn(f32) -> f32| {
            run(&move |step, grad| {
                if let Some((row, bad)) = spoiled.iter().find(|(row, _)| step == 3 * row + 2) {
                    grad[*row] = value(*bad);
                }
            })
        };
        let ended = with(|bad| bad);
        assert_eq!(ended, with(|_| 0.0));
        assert!(ended.iter().all(|x| x.is_finite()), "{ended:?}");
    }
}
