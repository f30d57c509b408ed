//! What can be wrong with the inputs of an op.

use burn::tensor::DType;

/// An input that an op refuses.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum OpError {
    /// A tensor has the wrong shape.
    #[error("{op}: `{tensor}` must have shape {expected}, got {got:?}")]
    Shape {
        /// The op.
        op: &'static str,
        /// The argument.
        tensor: &'static str,
        /// The shape it must have, in letters.
        expected: &'static str,
        /// The shape it has.
        got: Vec<usize>,
    },
    /// A tensor has a type that its device cannot compute with, or another than the first one.
    #[error("{op}: `{tensor}` has type {got:?}; {reason}")]
    DType {
        /// The op.
        op: &'static str,
        /// The argument.
        tensor: &'static str,
        /// Its type.
        got: DType,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// An ordinary argument is out of range.
    #[error("{op}: {what}")]
    Argument {
        /// The op.
        op: &'static str,
        /// What is wrong and what is allowed.
        what: String,
    },
}
