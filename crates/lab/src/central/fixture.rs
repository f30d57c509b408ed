//! Fixtures of a function in another framework: inputs, outputs, upstream gradients, and resulting
//! gradients.

use std::path::{Path, PathBuf};

use safetensors::{Dtype, SafeTensors};

use super::CheckError;
use super::checks::{check_inputs, check_outputs};
use super::function::{Closure, Function};
use super::inputs::{Inputs, NamedTensors};
use super::outputs::Outputs;
use super::report::{Comparison, Coverage, Finding, Kind, Report, Row};
use crate::gradcheck::{Array, check_unique_names, index_of};

/// Allowed difference, relative to the larger of an element and the root mean square of its tensor.
const TOLERANCE: f64 = 1e-9;

/// A fixture of a PyTorch function, written by `scripts/fixtures.py`.
///
/// | tensor | what it is |
/// |---|---|
/// | `x` | an input, or an output if `grad_x` is there |
/// | `grad.x` | the expected gradient of the input `x`; an input without one is a constant |
/// | `grad_y` | the upstream gradient of the output `y` |
///
/// All tensors are F64 (F32 is read, too). The metadata entry `outputs` lists the names of the
/// outputs in order, separated by commas.
#[derive(Debug, Clone)]
pub struct Fixture {
    file: PathBuf,
    tolerance: f64,
    inputs: Inputs,
    /// Gradients of the inputs, in order; `None` for constants.
    gradients: Vec<Option<Array>>,
    outputs: Vec<Output>,
}

#[derive(Debug, Clone)]
struct Output {
    name: String,
    expected: Array,
    upstream: Array,
}

/// Compares a function with a fixture of its PyTorch twin, written by `scripts/fixtures.py`:
/// outputs and gradients, to 1e-9.
///
/// The function receives the fixture's inputs by name and returns its outputs in the fixture's
/// order.
///
/// # Errors
/// When the file is not a valid fixture, the function fails, or its outputs have other shapes. A
/// wrong value is not an error; the report has it.
///
/// # Panics
/// When the function panics, or asks for an input that the fixture does not have.
///
/// ```no_run
/// use splat_lab::central::{NamedTensors, check_against_fixture};
///
/// let report = check_against_fixture("attention.safetensors", |at: &NamedTensors| {
///     let scores = at.get::<2>("q").matmul(at.get::<2>("k").transpose());
///     burn::tensor::activation::softmax(scores, 1).matmul(at.get::<2>("v"))
/// })?;
/// report.expect();
/// # Ok::<(), splat_lab::central::CheckError>(())
/// ```
pub fn check_against_fixture<F, O>(
    path: impl AsRef<Path>,
    function: F,
) -> Result<Report, CheckError>
where
    F: Fn(&NamedTensors) -> O,
    O: Outputs,
{
    Fixture::read(path)?.check(function)
}

impl Fixture {
    /// Reads a file.
    ///
    /// # Errors
    /// When the file cannot be read, is not safetensors, or contains something that would not be
    /// checked. The message names the file and the tensor.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, CheckError> {
        let file = path.as_ref().to_path_buf();
        Self::parse(&file).map_err(|reason| CheckError::Fixture { file, reason })
    }

    fn parse(file: &Path) -> Result<Self, String> {
        let bytes = std::fs::read(file).map_err(|error| error.to_string())?;
        let format = |error| format!("not a safetensors file: {error}");
        let (length, header) = SafeTensors::read_metadata(&bytes).map_err(format)?;
        check_unique_names(&bytes, length)?;
        let tensors = SafeTensors::deserialize(&bytes).map_err(format)?;
        let order = header.metadata().as_ref().and_then(|m| m.get("outputs"));
        let order: Vec<&str> = match order {
            Some(names) => names.split(',').collect(),
            None => return Err("metadata `outputs` is missing".into()),
        };
        let mut names = tensors.names();
        names.sort_unstable();

        let mut outputs = Vec::new();
        for name in &order {
            let expected = read(&tensors, name)?;
            let upstream = read(&tensors, &format!("grad_{name}"))?;
            same_shape(&format!("grad_{name}"), &upstream, &expected)?;
            let name = name.to_string();
            outputs.push(Output {
                name,
                expected,
                upstream,
            });
        }
        let (mut inputs, mut gradients) = (Inputs::new(), Vec::new());
        for name in &names {
            let upstream = name
                .strip_prefix("grad_")
                .is_some_and(|of| order.contains(&of));
            if order.contains(name) || upstream {
                continue;
            }
            if let Some(of) = name.strip_prefix("grad.") {
                if !names.contains(&of) || order.contains(&of) {
                    return Err(format!("tensor `{name}`: there is no input `{of}`"));
                }
                continue;
            }
            let array = read(&tensors, name)?;
            let gradient = format!("grad.{name}");
            gradients.push(match names.contains(&gradient.as_str()) {
                false => None,
                true => {
                    let read = read(&tensors, &gradient)?;
                    same_shape(&gradient, &read, &array)?;
                    Some(read)
                }
            });
            inputs = inputs.with_array(*name, array);
        }
        Ok(Self {
            file: file.to_path_buf(),
            tolerance: TOLERANCE,
            inputs,
            gradients,
            outputs,
        })
    }

    /// Sets the allowed difference, relative to the larger of an element and the root mean square
    /// of its tensor. Default 1e-9.
    pub fn with_tolerance(mut self, tolerance: f64) -> Self {
        self.tolerance = tolerance;
        self
    }

    /// The inputs, for use with [`gradcheck`](super::gradcheck) as well.
    pub fn inputs(&self) -> Inputs {
        self.inputs.clone()
    }

    /// Upstream gradients of all outputs, for
    /// [`Settings::with_upstream`](super::Settings::with_upstream).
    pub fn upstream(&self) -> Vec<f64> {
        let outputs = self.outputs.iter();
        outputs.flat_map(|o| o.upstream.values.clone()).collect()
    }

    /// Compares a function's outputs and gradients with the fixture's.
    ///
    /// # Errors
    /// When the function fails, or its outputs have other shapes or are not finite.
    ///
    /// # Panics
    /// When the function panics, or asks for an input that the fixture does not have.
    pub fn check<F, O>(&self, function: F) -> Result<Report, CheckError>
    where
        F: Fn(&NamedTensors) -> O,
        O: Outputs,
    {
        let closure = Closure::<Inputs, _>::new(|tensors: NamedTensors| function(&tensors));
        check_inputs(&self.inputs)?;
        let tracked: Vec<bool> = self.gradients.iter().map(Option::is_some).collect();
        let found = closure.gradients(&self.inputs, &tracked, &|shapes| {
            let expected: Vec<_> = self
                .outputs
                .iter()
                .map(|o| o.expected.shape.clone())
                .collect();
            if shapes == expected {
                return Ok(self.upstream());
            }
            Err(CheckError::Fixture {
                file: self.file.clone(),
                reason: format!("outputs have shapes {expected:?}, the function's have {shapes:?}"),
            })
        })?;
        check_outputs(&found.outputs)?;
        let mut rows = Vec::new();
        for (output, ours) in self.outputs.iter().zip(&found.outputs) {
            rows.push(self.row(&output.name, Some(&ours.values), &output.expected));
        }
        for (((name, array), expected), ours) in self
            .inputs
            .iter()
            .zip(&self.gradients)
            .zip(&found.gradients)
        {
            rows.push(match expected {
                Some(expected) => self.row(&format!("grad.{name}"), ours.as_ref(), expected),
                None => Row::constant(name, &array.shape),
            });
        }
        Ok(Report {
            compared_with: "expected",
            rows,
        })
    }

    fn row(&self, name: &str, ours: Option<&Vec<f64>>, expected: &Array) -> Row {
        let zeros = vec![0.0; expected.values.len()];
        let values = ours.unwrap_or(&zeros);
        let rms = expected.rms();
        let severity = |i: usize| {
            let (a, b) = (values[i], expected.values[i]);
            match (a - b).abs() {
                0.0 => 0.0,
                difference => difference / (self.tolerance * b.abs().max(rms)),
            }
        };
        // NaN compares greater than every number here.
        let worst = (0..values.len()).max_by(|a, b| severity(*a).total_cmp(&severity(*b)));
        let worst = worst.map(|i| {
            let comparison = Comparison {
                at: Some(index_of(i, &expected.shape)),
                analytic: values[i],
                numeric: expected.values[i],
                error: 0.0,
            };
            (severity(i), comparison)
        });
        let finding = worst.clone().filter(|(severity, _)| !(*severity <= 1.0));
        let kind = match ours {
            Some(_) => Kind::Wrong,
            None => Kind::NoGradient,
        };
        Row {
            name: name.into(),
            shape: expected.shape.clone(),
            coverage: Coverage::Elements(values.len()),
            worst: worst.map(|(_, comparison)| comparison),
            all_zero: values.iter().chain(&expected.values).all(|x| *x == 0.0),
            findings: finding
                .map(|(_, comparison)| Finding { kind, comparison })
                .into_iter()
                .collect(),
        }
    }
}

fn read(tensors: &SafeTensors, name: &str) -> Result<Array, String> {
    let view = tensors
        .tensor(name)
        .map_err(|_| format!("tensor `{name}` is missing"))?;
    let data = view.data();
    let values: Vec<f64> = match view.dtype() {
        Dtype::F64 => data
            .as_chunks()
            .0
            .iter()
            .map(|b| f64::from_le_bytes(*b))
            .collect(),
        Dtype::F32 => data
            .as_chunks()
            .0
            .iter()
            .map(|b| f32::from_le_bytes(*b).into())
            .collect(),
        other => {
            return Err(format!(
                "tensor `{name}` has type {other:?}, must be F64 or F32"
            ));
        }
    };
    let shape = match view.shape() {
        [] => vec![1],
        shape => shape.to_vec(),
    };
    if let Some(i) = values.iter().position(|x| !x.is_finite()) {
        return Err(format!(
            "tensor `{name}` is {} at {:?}, must be finite",
            values[i],
            index_of(i, &shape)
        ));
    }
    Ok(Array { shape, values })
}

fn same_shape(name: &str, got: &Array, expected: &Array) -> Result<(), String> {
    if got.shape == expected.shape {
        return Ok(());
    }
    Err(format!(
        "tensor `{name}` has shape {:?}, must have {:?}",
        got.shape, expected.shape
    ))
}
