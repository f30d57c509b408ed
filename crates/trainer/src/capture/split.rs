//! Which views are trained on and which are held out.

/// Indices into the views of a capture, each list ascending.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Split {
    /// Views to train on.
    pub train: Vec<usize>,
    /// Views held out.
    pub test: Vec<usize>,
}
