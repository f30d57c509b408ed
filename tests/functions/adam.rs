//! Runs of PyTorch's Adam on one parameter, and of ours.

use burn::tensor::{Device, Int, Tensor, TensorData};
use splat_model::optimizer::{FieldOptimizer, MomentEdit, SplatAdam};

use super::fixture::{Array, Fixture, Place, Row, distance, read};

pub const FILES: [&str; 3] = ["adam_few_steps", "adam_rows", "adam_spike"];

/// What can be wrong with an optimiser.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Bug {
    /// Moments are taken as they are, as if they had not begun at zero.
    NoBiasCorrection,
    /// Burn's default, 1e-5.
    LargeEpsilon,
    /// Rows that begin anew keep the moments of the row that they come from.
    MomentsKept,
    /// Steps are counted from the last edit of rows.
    CounterReset,
    /// Moments and counter begin anew with every edit of rows.
    StateDropped,
    /// Moments stay where they were when rows move.
    MomentsLeftBehind,
    /// Steps without a gradient do not count.
    IdleStepsSkipped,
}

/// A file, and a bug that it must notice.
pub const BUGS: &[(&str, Bug)] = &[
    ("adam_few_steps", Bug::NoBiasCorrection),
    ("adam_few_steps", Bug::LargeEpsilon),
    ("adam_rows", Bug::MomentsKept),
    ("adam_rows", Bug::CounterReset),
    ("adam_rows", Bug::StateDropped),
    ("adam_rows", Bug::MomentsLeftBehind),
    ("adam_spike", Bug::IdleStepsSkipped),
];

struct Run {
    optimizer: FieldOptimizer,
    param: Tensor<2>,
    rate: f64,
    steps: usize,
    since_edit: usize,
    bug: Option<Bug>,
}

/// Compares parameters, over each segment as a whole, and moments, row by row.
pub fn check(fixture: &Fixture, place: &Place, bug: Option<Bug>) -> Vec<Row> {
    let number = |name: &str| fixture.text(name).parse::<f64>().expect("a number");
    let device = &place.device;
    let mut run = Run {
        optimizer: optimizer(fixture, bug),
        param: place.tensor(&fixture.tensors["start"], device),
        rate: number("rate"),
        steps: 0,
        since_edit: 0,
        bug,
    };
    let mut rows = Vec::new();
    for segment in 0..number("segments") as usize {
        let name = |what: &str| format!("segment.{segment}.{what}");
        let get = |what: &str| &fixture.tensors[&name(what)];
        if fixture.tensors.contains_key(&name("source")) {
            run.edit(fixture, get("source"), get("restart"), device);
        }
        let idle = get("zero_steps").values[0] as usize;
        if bug != Some(Bug::IdleStepsSkipped) {
            for _ in 0..idle {
                run.step(run.param.zeros_like());
            }
        }
        let gradients = place.tensor::<3>(get("gradients"), device);
        let [count, n, width] = gradients.dims();
        let mut params = Vec::new();
        for step in 0..count {
            let gradient = gradients.clone().narrow(0, step, 1).reshape([n, width]);
            run.step(gradient);
            params.extend(read(run.param.clone()));
        }
        let mut row = |what: &str, found: &[f64], per_row: bool| {
            let expected = get(what);
            rows.push(Row {
                name: name(what),
                error: error(found, expected, if per_row { width } else { found.len() }),
                gate: fixture.gate(place),
            });
        };
        row("params", &params, false);
        let state = run.optimizer.save();
        for moment in ["moment_1", "moment_2"] {
            row(
                moment,
                &state.tensors[moment].iter().collect::<Vec<f64>>(),
                true,
            );
        }
    }
    rows
}

/// The largest relative L2 error of parts of this length; infinite where zeros are expected and
/// something else was found.
fn error(found: &[f64], expected: &Array, part: usize) -> f64 {
    if found.len() != expected.values.len() {
        return f64::NAN;
    }
    let parts = found.chunks(part).zip(expected.values.chunks(part));
    let errors = parts.map(|(found, expected)| match distance(found, expected) {
        0.0 => 0.0,
        off => off / distance(expected, &vec![0.0; expected.len()]),
    });
    // NaN is kept.
    errors.fold(
        0.0,
        |most: f64, error| if error <= most { most } else { error },
    )
}

fn optimizer(fixture: &Fixture, bug: Option<Bug>) -> FieldOptimizer {
    let number = |name: &str| fixture.text(name).parse::<f64>().expect("a number");
    let mut adam = SplatAdam::new();
    assert_eq!(
        [adam.beta_1, adam.beta_2, adam.epsilon],
        ["beta_1", "beta_2", "epsilon"].map(number),
        "our defaults are those of 3DGS"
    );
    if bug == Some(Bug::LargeEpsilon) {
        adam.epsilon = 1e-5;
    }
    adam.into()
}

/// Of the bias of both moments after so many steps.
fn correction(steps: usize) -> f64 {
    let [first, second] = [0.9f64, 0.999].map(|beta| 1.0 - beta.powf(steps as f64));
    second.sqrt() / first
}

impl Run {
    fn step(&mut self, gradient: Tensor<2>) {
        self.steps += 1;
        self.since_edit += 1;
        // The optimiser corrects the bias itself: a wrong correction is one by the quotient.
        let wrong = match self.bug {
            Some(Bug::NoBiasCorrection) => 1.0 / correction(self.steps),
            Some(Bug::CounterReset) => correction(self.since_edit) / correction(self.steps),
            _ => 1.0,
        };
        let rate = self.rate * wrong;
        self.param = self.optimizer.step(rate, self.param.clone(), gradient);
    }

    fn edit(&mut self, fixture: &Fixture, source: &Array, restart: &Array, device: &Device) {
        let rows = source.values.iter().map(|row| *row as i32);
        let rows = TensorData::from(rows.collect::<Vec<_>>().as_slice());
        let source = Tensor::<1, Int>::from_data(rows, device);
        let keep = self.bug == Some(Bug::MomentsKept);
        let restarts: Vec<bool> = restart.values.iter().map(|x| *x == 1.0 && !keep).collect();
        let count = restarts.len();
        self.param = self.param.clone().select(0, source.clone());
        let moved = match self.bug {
            Some(Bug::MomentsLeftBehind) => {
                let places: Vec<i32> = (0..count as i32).map(|row| row.min(3)).collect();
                Tensor::from_data(TensorData::from(places.as_slice()), device)
            }
            _ => source,
        };
        self.optimizer.edit_rows(&MomentEdit::Gather {
            source: moved,
            restarts: Tensor::from_data(TensorData::from(restarts.as_slice()), device),
        });
        if self.bug == Some(Bug::StateDropped) {
            self.optimizer = optimizer(fixture, None);
        }
        self.since_edit = 0;
    }
}
