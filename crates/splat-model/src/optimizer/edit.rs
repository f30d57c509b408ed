//! Edits of moments on the device, for optimisers of the Adam family.

use burn::optim::{Adam, AdamState, AdamW, AdamWState, AdaptiveMomentumState, Optimizer};
use burn::tensor::{Bool, Int, Tensor};

use super::state_record::StateRecord;

/// The effect of a row edit on a moment.
#[derive(Debug, Clone)]
#[expect(clippy::large_enum_variant, reason = "a handful exist at a time")]
pub enum MomentEdit {
    /// Row i continues the moments of row `source[i]`, or restarts if `restarts[i]`.
    Gather {
        /// `[N_new]`, indices into the old rows.
        source: Tensor<1, Int>,
        /// `[N_new]`.
        restarts: Tensor<1, Bool>,
    },
    /// Rows are cut into parts of one width; row i continues the moments of part `source[i]`,
    /// counted through all rows.
    Cut {
        /// Parts of a row, of which its width is a multiple.
        parts: usize,
        /// `[N_new]`, indices into the parts of the old rows.
        source: Tensor<1, Int>,
    },
    /// All rows restart.
    Restart,
}

impl MomentEdit {
    /// The moment `[N, width]` after the edit, `[N_new, width]`, or `[N_new, width / parts]` where
    /// rows are cut.
    pub fn apply(&self, moment: Tensor<2>) -> Tensor<2> {
        match self {
            Self::Cut { parts, source } => {
                let [rows, width] = moment.dims();
                let width = width / (*parts).max(1);
                if source.dims()[0] == 0 {
                    return Tensor::zeros([0, width], (&moment.device(), moment.dtype()));
                }
                moment
                    .reshape([rows * parts, width])
                    .select(0, source.clone())
            }
            Self::Gather { source, .. } if source.dims()[0] == 0 => {
                let [_, width] = moment.dims();
                Tensor::zeros([0, width], (&moment.device(), moment.dtype()))
            }
            Self::Gather { source, restarts } => {
                let [_, width] = moment.dims();
                let moment = moment.select(0, source.clone());
                // Filled rather than multiplied by zero, which would keep NaN.
                let restarts = restarts.clone().unsqueeze_dim::<2>(1).repeat_dim(1, width);
                moment.mask_fill(restarts, 0.0)
            }
            Self::Restart => moment.zeros_like(),
        }
    }
}

/// A Burn optimiser whose state can follow row edits. [`ThroughHost`](super::ThroughHost) turns any
/// other optimiser into one.
pub trait RowOptimizer: Optimizer {
    /// State of a parameter `[N, width]` after an edit of its rows.
    fn edit_rows(state: Self::State<2>, edit: &MomentEdit) -> Self::State<2>;

    /// Checks a saved state against the shape of its parameter before it is loaded. By default
    /// every tensor must have that shape.
    ///
    /// # Errors
    /// The mismatch, in one line.
    fn check_state(record: &StateRecord, shape: [usize; 2]) -> Result<(), String> {
        match record
            .tensors
            .iter()
            .find(|(_, data)| data.shape()[..] != shape)
        {
            None => Ok(()),
            Some((name, data)) => Err(format!(
                "`{name}` has shape {:?} instead of {shape:?}",
                data.shape().to_vec()
            )),
        }
    }
}

impl RowOptimizer for Adam {
    fn edit_rows(state: AdamState<2>, edit: &MomentEdit) -> AdamState<2> {
        AdamState {
            momentum: adaptive(state.momentum, edit),
        }
    }
}

impl RowOptimizer for AdamW {
    fn edit_rows(state: AdamWState<2>, edit: &MomentEdit) -> AdamWState<2> {
        AdamWState {
            momentum: adaptive(state.momentum, edit),
        }
    }
}

fn adaptive(state: AdaptiveMomentumState<2>, edit: &MomentEdit) -> AdaptiveMomentumState<2> {
    AdaptiveMomentumState {
        time: state.time,
        moment_1: edit.apply(state.moment_1),
        moment_2: edit.apply(state.moment_2),
        max_moment_2: state.max_moment_2.map(|moment| edit.apply(moment)),
    }
}
