//! What strategies have to do with steps of some rows.

use splat_ops::RowGroups;

use super::{ScreenView, StepInfo};
use crate::FieldGradients;

/// Rows that a strategy needs around a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum RowsNeeded {
    /// All, before the optimiser's step and after it.
    #[default]
    All,
    /// Before the step those that its views may see, after it all.
    AllAfter,
    /// Those that the views of the step may see. There is no [`after_step`] then, unless the step
    /// is taken with all rows all the same.
    ///
    /// [`after_step`]: super::Strategy::after_step
    Seen,
}

/// A step of some rows, before the optimiser.
pub struct SparseStep<'a> {
    /// How many steps are done, those before this one.
    pub at: StepInfo,
    /// The rows: all that the views of the step may see. Those left out have no gradient.
    pub rows: &'a RowGroups,
    /// Gradients of the fields, `[N', width]`: of the rows, in their order.
    pub gradients: &'a mut FieldGradients,
    /// The training views of the step, with the splats of the rows.
    pub screen: &'a [ScreenView],
}
