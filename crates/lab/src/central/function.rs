//! Evaluation and differentiation of a closure.

use std::marker::PhantomData;

use burn::tensor::DType;

use super::CheckError;
use super::inputs::{Arguments, Inputs, read, tensor};
use super::outputs::{Outputs, Part};
use crate::gradcheck::Array;

/// Computes the weights of all outputs' elements from the outputs' shapes.
pub(super) type Weights<'a> = dyn Fn(&[Vec<usize>]) -> Result<Vec<f64>, CheckError> + 'a;

/// A function from arrays to arrays.
pub(super) trait Function {
    /// The outputs.
    fn outputs(&self, inputs: &Inputs) -> Result<Vec<Array>, CheckError>;

    /// The outputs, and the gradients of their sum under `weights`, by input; `None` if autodiff
    /// has none.
    fn gradients(
        &self,
        inputs: &Inputs,
        tracked: &[bool],
        weights: &Weights,
    ) -> Result<Differentiated, CheckError>;
}

/// Result of [`Function::gradients`].
pub(super) struct Differentiated {
    pub outputs: Vec<Array>,
    /// Weights of all outputs' elements, concatenated.
    pub weights: Vec<f64>,
    pub gradients: Vec<Option<Vec<f64>>>,
}

/// A closure that takes the tensors of `A`.
pub(super) struct Closure<A, F> {
    function: F,
    arguments: PhantomData<A>,
}

impl<A, F> Closure<A, F> {
    pub(super) fn new(function: F) -> Self {
        Self {
            function,
            arguments: PhantomData,
        }
    }
}

impl<A, F, O> Closure<A, F>
where
    A: Arguments,
    F: Fn(A::Tensors) -> O,
    O: Outputs,
{
    fn parts(&self, tensors: A::Tensors) -> Result<Vec<Part>, CheckError> {
        let parts = (self.function)(tensors)
            .parts()
            .map_err(CheckError::Function)?;
        for (i, part) in parts.iter().enumerate() {
            let dtype = part.flat.dtype();
            if dtype != DType::F64 {
                return Err(CheckError::Outputs(format!(
                    "output {i} has type {dtype:?}, must be F64: inputs are in F64, so keep the type of what comes in"
                )));
            }
            if part.shape.contains(&0) {
                return Err(CheckError::Outputs(format!(
                    "output {i} has shape {:?}, there is nothing to differentiate",
                    part.shape
                )));
            }
        }
        Ok(parts)
    }
}

impl<A, F, O> Function for Closure<A, F>
where
    A: Arguments,
    F: Fn(A::Tensors) -> O,
    O: Outputs,
{
    fn outputs(&self, inputs: &Inputs) -> Result<Vec<Array>, CheckError> {
        let untracked = vec![false; inputs.entries.len()];
        let parts = self.parts(A::tensors(inputs, &untracked))?;
        Ok(parts.into_iter().map(array).collect())
    }

    fn gradients(
        &self,
        inputs: &Inputs,
        tracked: &[bool],
        weights: &Weights,
    ) -> Result<Differentiated, CheckError> {
        let leaves = A::tensors(inputs, tracked);
        let parts = self.parts(A::share(&leaves))?;
        let shapes: Vec<_> = parts.iter().map(|part| part.shape.clone()).collect();
        let weights = weights(&shapes)?;
        let mut rest = weights.as_slice();
        let mut loss = tensor([0.0], [1]);
        for part in &parts {
            let (these, others) = rest.split_at(part.flat.dims()[0]);
            rest = others;
            loss = loss + (part.flat.clone() * tensor(these, [these.len()])).sum();
        }
        let gradients = if loss.is_tracked() {
            A::gradients(&leaves, &loss.backward())
        } else {
            vec![None; tracked.len()]
        };
        Ok(Differentiated {
            outputs: parts.into_iter().map(array).collect(),
            weights,
            gradients,
        })
    }
}

fn array(part: Part) -> Array {
    Array {
        shape: part.shape,
        values: read(part.flat),
    }
}
