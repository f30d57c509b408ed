//! Gradient checks of any function of Burn tensors, by central differences in double precision on
//! the CPU.
//!
//! ```
//! use splat_lab::central::{gradcheck, tensor};
//!
//! let x = tensor([0.5, -1.0, 2.0, 0.3, 0.7, -0.2], [2, 3]);
//! let w = tensor([1.0, 0.4, -0.6], [3, 1]);
//! let bias = tensor([0.1], [1]);
//! let report = gradcheck(
//!     |(x, w, bias)| x.matmul(w).tanh() + bias.unsqueeze(),
//!     (("x", x), ("w", w), ("bias", bias)),
//! )?;
//! println!("{report}");
//! report.expect();
//!
//! // A function whose gradient is wrong: the second factor is detached.
//! let report = gradcheck(
//!     |[x, y]| x * y.detach(),
//!     [("x", tensor([1.0, 2.0], [2])), ("y", tensor([3.0, 4.0], [2]))],
//! )?;
//! let failure = report.check().unwrap_err().to_string();
//! assert!(failure.starts_with("`y` at [0]: no gradient, numeric "), "{failure}");
//! # Ok::<(), splat_lab::central::CheckError>(())
//! ```
//!
//! The outputs are summed with fixed random weights. One backward pass gives the analytic gradient.
//! The numeric one comes from central differences at decreasing steps, extrapolated, with an error
//! estimate (`ladder.rs`). An element passes if both agree within that error and a tolerance.
//! Inputs of more than 1000 elements are moved along random directions, and disagreements are
//! traced to their elements (`search.rs`). Points where the slopes on the left and right differ are
//! reported as kinks.
//!
//! [`Fixture`] compares with gradients from another framework; [`check_against_fixture`] does so in
//! one call.

mod checks;
mod error;
mod fixture;
mod function;
mod inputs;
mod judge;
mod ladder;
mod line;
mod noise;
mod outputs;
mod report;
mod sample;
mod search;
mod settings;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

pub use error::CheckError;
pub use fixture::{Fixture, check_against_fixture};
pub use inputs::{Arguments, Inputs, NamedTensors, tensor};
pub use outputs::Outputs;
pub use report::{Comparison, Coverage, Failure, Finding, Kind, Report, Row};
pub use settings::Settings;

use checks::{check_gradients, check_inputs, check_outputs, check_repeats, check_settings};
use function::{Closure, Differentiated, Function};
use line::Probe;
use search::Search;

/// Checks the gradient of a function at the given inputs, with default [`Settings`].
///
/// - `function`: any closure of tensors that returns a tensor, a tuple of up to four, or a `Result`
///   of either. It is evaluated in double precision on the CPU; create other tensors that it needs
///   with [`tensor`].
/// - `inputs`: named tensors of any ranks, float types and devices, see [`Arguments`].
///
/// # Errors
/// When the function returns an error, gives values or gradients that are not finite, gives
/// different values when repeated, or computes in another precision; or when an input is empty, not
/// finite, or named twice. A wrong gradient is not an error; the report has it.
///
/// # Panics
/// When the function panics.
///
/// ```
/// use splat_lab::central::{gradcheck, tensor};
///
/// let report = gradcheck(|x| x.sin().exp(), ("x", tensor([0.3, -1.2], [2])))?;
/// assert!(report.is_ok());
/// assert!(report.worst_relative() < 1e-9);
/// # Ok::<(), splat_lab::central::CheckError>(())
/// ```
pub fn gradcheck<A, F, O>(function: F, inputs: A) -> Result<Report, CheckError>
where
    A: Arguments,
    F: Fn(A::Tensors) -> O,
    O: Outputs,
{
    gradcheck_with(function, inputs, &Settings::new())
}

/// [`gradcheck`] with settings.
///
/// # Errors
/// Those of [`gradcheck`], and when a setting is invalid.
///
/// # Panics
/// When the function panics.
///
/// ```
/// use splat_lab::central::{Settings, gradcheck_with, tensor};
///
/// // At zero, |x| has the slopes -1 and 1. Burn's gradient of 0 lies between, and passes unless kinks are refused.
/// let x = tensor([1.0, 0.0], [2]);
/// let settings = Settings::new().with_upstream([1.0, 1.0]);
/// let report = gradcheck_with(|x| x.abs(), ("x", x.clone()), &settings)?;
/// assert!(report.is_ok());
/// assert!(report.to_string().contains("`x` at [1]: a kink"));
///
/// let report = gradcheck_with(|x| x.abs(), ("x", x), &settings.with_kinks_refused())?;
/// assert!(!report.is_ok());
/// # Ok::<(), splat_lab::central::CheckError>(())
/// ```
pub fn gradcheck_with<A, F, O>(
    function: F,
    inputs: A,
    settings: &Settings,
) -> Result<Report, CheckError>
where
    A: Arguments,
    F: Fn(A::Tensors) -> O,
    O: Outputs,
{
    let inputs = inputs.into_inputs();
    check(&Closure::<A, F>::new(function), inputs, settings)
}

fn check(
    function: &dyn Function,
    inputs: Inputs,
    settings: &Settings,
) -> Result<Report, CheckError> {
    check_inputs(&inputs)?;
    check_settings(settings, &inputs)?;
    let tracked: Vec<bool> = inputs
        .iter()
        .map(|(name, _)| !settings.constants.iter().any(|constant| constant == name))
        .collect();
    let outputs = function.outputs(&inputs)?;
    check_outputs(&outputs)?;
    let found = function.gradients(&inputs, &tracked, &|shapes| weights(shapes, settings))?;
    check_repeats(&outputs, &found.outputs)?;
    check_gradients(&inputs, &found.gradients)?;

    let Differentiated {
        weights, gradients, ..
    } = found;
    let middle = outputs.into_iter().flat_map(|output| output.values);
    let mut probe = Probe::new(function, inputs.clone(), middle.collect(), weights);
    let mut rows = Vec::new();
    for (i, (name, array)) in inputs.iter().enumerate() {
        if !tracked[i] {
            rows.push(Row::constant(name, &array.shape));
            continue;
        }
        let search = Search {
            probe: &mut probe,
            settings,
            input: i,
            shape: &array.shape,
            values: &array.values,
            gradient: gradients[i].as_deref(),
        };
        rows.push(search.run(name)?);
    }
    Ok(Report {
        compared_with: "numeric",
        rows,
    })
}

/// Weights of the outputs' elements: from the settings, or random from 0.5 to 1 with random signs.
fn weights(shapes: &[Vec<usize>], settings: &Settings) -> Result<Vec<f64>, CheckError> {
    let count = shapes
        .iter()
        .map(|shape| shape.iter().product::<usize>())
        .sum();
    match &settings.upstream {
        Some(upstream) if upstream.len() == count => Ok(upstream.clone()),
        Some(upstream) => Err(CheckError::Settings(format!(
            "{} upstream gradients for outputs of shapes {shapes:?}, which have {count} elements",
            upstream.len()
        ))),
        None => {
            let mut rng = Pcg64Mcg::seed_from_u64(settings.seed.wrapping_add(1));
            let sign = |rng: &mut Pcg64Mcg| {
                if rng.random_range(0..2) == 0 {
                    1.0
                } else {
                    -1.0
                }
            };
            Ok((0..count)
                .map(|_| sign(&mut rng) * rng.random_range(0.5..1.0))
                .collect())
        }
    }
}
