//! Preconditions of a gradient check.

use super::{CheckError, Inputs, Settings};
use crate::gradcheck::{Array, index_of};

/// Checks that inputs exist, have finite elements, and distinct names.
pub(super) fn check_inputs(inputs: &Inputs) -> Result<(), CheckError> {
    if inputs.entries.is_empty() {
        return Err(CheckError::Inputs("there are none".into()));
    }
    for (i, (name, array)) in inputs.iter().enumerate() {
        let shape = &array.shape;
        if array.values.is_empty() {
            return Err(CheckError::Inputs(format!(
                "`{name}` has shape {shape:?}, without elements there is nothing to check"
            )));
        }
        if array.values.len() != shape.iter().product::<usize>() {
            return Err(CheckError::Inputs(format!(
                "`{name}` has shape {shape:?} and {} values",
                array.values.len()
            )));
        }
        if inputs.iter().take(i).any(|(other, _)| other == name) {
            return Err(CheckError::Inputs(format!("two are named `{name}`")));
        }
        if let Some((at, value)) = not_finite(&array.values, shape) {
            return Err(CheckError::InputNotFinite {
                input: name.into(),
                at,
                value,
            });
        }
    }
    Ok(())
}

/// Checks that numbers are in range and names are those of inputs.
pub(super) fn check_settings(settings: &Settings, inputs: &Inputs) -> Result<(), CheckError> {
    let positive = [
        ("tolerance", settings.tolerance),
        ("safety", settings.safety),
        ("step", settings.step),
    ];
    for (name, value) in positive {
        if !(value > 0.0 && value.is_finite()) {
            return Err(CheckError::Settings(format!(
                "{name} is {value}, must be above 0 and finite"
            )));
        }
    }
    if settings.directions == 0 {
        return Err(CheckError::Settings(
            "directions are 0, must be at least 1".into(),
        ));
    }
    for constant in &settings.constants {
        if !inputs.iter().any(|(name, _)| name == constant) {
            return Err(CheckError::Settings(format!(
                "the constant `{constant}` is no input"
            )));
        }
    }
    Ok(())
}

/// Checks that outputs are finite.
pub(super) fn check_outputs(outputs: &[Array]) -> Result<(), CheckError> {
    for (output, array) in outputs.iter().enumerate() {
        if let Some((at, value)) = not_finite(&array.values, &array.shape) {
            return Err(CheckError::OutputNotFinite { output, at, value });
        }
    }
    Ok(())
}

/// Checks that both evaluations agree to nine digits of the largest element; the pass with
/// gradients may sum in another order.
pub(super) fn check_repeats(outputs: &[Array], again: &[Array]) -> Result<(), CheckError> {
    for (output, (first, second)) in outputs.iter().zip(again).enumerate() {
        let most = first
            .values
            .iter()
            .fold(0.0, |most: f64, x| most.max(x.abs()));
        let mut pairs = first.values.iter().zip(&second.values);
        // Written so that NaN is detected.
        let differs = |(a, b): (&f64, &f64)| !((a - b).abs() <= 1e-9 * most);
        if let Some(i) = pairs.position(differs) {
            return Err(CheckError::NotDeterministic {
                output,
                at: index_of(i, &first.shape),
                first: first.values[i],
                second: second.values[i],
            });
        }
    }
    Ok(())
}

/// Checks that gradients are finite.
pub(super) fn check_gradients(
    inputs: &Inputs,
    gradients: &[Option<Vec<f64>>],
) -> Result<(), CheckError> {
    for ((input, array), gradient) in inputs.iter().zip(gradients) {
        let gradient = gradient.as_deref().unwrap_or_default();
        if let Some((at, value)) = not_finite(gradient, &array.shape) {
            return Err(CheckError::GradientNotFinite {
                input: input.into(),
                at,
                value,
            });
        }
    }
    Ok(())
}

fn not_finite(values: &[f64], shape: &[usize]) -> Option<(Vec<usize>, f64)> {
    let i = values.iter().position(|x| !x.is_finite())?;
    Some((index_of(i, shape), values[i]))
}
