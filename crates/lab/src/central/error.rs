//! Errors of gradient checks.

use std::path::PathBuf;

/// Why a function cannot be checked. A wrong gradient is not an error but a finding of the
/// [`Report`](super::Report).
#[derive(Debug, thiserror::Error)]
pub enum CheckError {
    /// The function returned an error.
    #[error("the function failed: {0}")]
    Function(String),
    /// The inputs cannot be checked.
    #[error("inputs: {0}")]
    Inputs(String),
    /// A setting is invalid.
    #[error("settings: {0}")]
    Settings(String),
    /// The outputs cannot be differentiated.
    #[error("outputs: {0}")]
    Outputs(String),
    /// An input contains NaN or infinity.
    #[error(
        "input `{input}` is {value} at {at:?}: gradients are checked at finite inputs, choose another"
    )]
    InputNotFinite {
        /// Name of the input.
        input: String,
        /// Index of the element.
        at: Vec<usize>,
        /// Its value.
        value: f64,
    },
    /// An output contains NaN or infinity.
    #[error(
        "output {output} is {value} at {at:?}: choose inputs in the function's domain, or correct the function there"
    )]
    OutputNotFinite {
        /// Index of the output, from 0.
        output: usize,
        /// Index of the element.
        at: Vec<usize>,
        /// Its value.
        value: f64,
    },
    /// An analytic gradient contains NaN or infinity.
    #[error(
        "the gradient of input `{input}` is {value} at {at:?}: mask that point before the operation that cannot be differentiated there"
    )]
    GradientNotFinite {
        /// Name of the input.
        input: String,
        /// Index of the element.
        at: Vec<usize>,
        /// The gradient there.
        value: f64,
    },
    /// Two evaluations at the same inputs differ.
    #[error(
        "output {output} is {first} at {at:?}, and {second} when computed again with gradients: fix seeds, and keep no state"
    )]
    NotDeterministic {
        /// Index of the output, from 0.
        output: usize,
        /// Index of the element.
        at: Vec<usize>,
        /// Its value without gradients.
        first: f64,
        /// Its value with gradients.
        second: f64,
    },
    /// A fixture cannot be read, or does not match the function.
    #[error("{}: {reason}", .file.display())]
    Fixture {
        /// The file.
        file: PathBuf,
        /// The reason.
        reason: String,
    },
}
