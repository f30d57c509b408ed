//! Strategies: which Gaussians a scene needs, and what else may change while it is trained.
//!
//! A [`Strategy`] is given to the trainer and called around every step of the optimiser. It sees
//! gradients, parameters and rows, and may edit rows ([`RowEdit`](crate::RowEdit)), add terms to
//! the loss, pause and scale the steps of fields, set the first Gaussians and the size of the
//! photos, and render other training views. [`Adc`] is that of 3DGS and AbsGS, [`Mcmc`] that of
//! Kheradmand et al. 2024, [`ImprovedGs`] those of Deng et al. 2025, Improved-GS and GNS.

mod adc;
mod draw;
mod improved;
mod mcmc;
mod relocation;
mod schedule;
mod scores;
mod screen_sums;
mod sparse_step;
mod splats;
#[cfg(all(test, feature = "cpu"))]
mod tests;

use burn::tensor::{Device, Tensor};
use splat_ops::{OpError, Projected, Rendered};

use crate::field::Field;
use crate::optimizer::StateRecord;
use crate::{
    CameraTensors, FieldGradients, FieldStep, InitSettings, Optimized, RenderSettings, SplatModel,
};

pub use adc::{Adc, AdcSettings};
pub use improved::{ImprovedGs, ImprovedGsSettings, SelectionSettings};
pub use mcmc::{Mcmc, McmcSettings};
pub use relocation::relocate;
pub use schedule::{RunSchedule, StepInfo};
pub use scores::weighted_contributions;
pub use sparse_step::{RowsNeeded, SparseStep};

/// Screen gradients that a strategy needs in a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct ScreenWants {
    /// Gradients of the packed screen splats, which cost a probe in the graph.
    pub gradients: bool,
    /// Absolute gradients of the screen means, which cost two sums more in the backward pass of the
    /// rasteriser.
    pub absgrad: bool,
}

impl ScreenWants {
    /// Nothing.
    pub fn nothing() -> Self {
        Self::default()
    }

    /// The gradients of the screen splats.
    pub fn gradients() -> Self {
        Self {
            gradients: true,
            ..Self::nothing()
        }
    }

    /// The absolute gradients of the screen means.
    pub fn absgrad() -> Self {
        Self {
            absgrad: true,
            ..Self::nothing()
        }
    }
}

/// The splats of one training view of a step, and their gradients.
#[derive(Debug)]
pub struct ScreenView {
    /// Index of the view among those that are trained on.
    pub view: usize,
    /// The splats.
    pub projected: Projected,
    /// Gradient `[C, N, 9]` of their packed rows, of the loss of this view alone, where the
    /// strategy wanted it.
    pub gradient: Option<Tensor<3>>,
    /// Absolute gradient `[C, N, 2]` of their screen means, likewise, see
    /// [`Projected::with_absgrad`].
    pub absgrad: Option<Tensor<3>>,
}

/// A rendered training view, before the backward pass.
#[derive(Debug)]
pub struct Pass<'a, M> {
    /// The step, counted from 0.
    pub at: StepInfo,
    /// Index of the view among those that are trained on.
    pub view: usize,
    /// The model.
    pub model: &'a M,
    /// Its splats on the screen.
    pub projected: &'a Projected,
    /// The picture.
    pub rendered: &'a Rendered,
}

/// The state that a strategy can read and change around a step of the optimiser.
pub struct StepContext<'a, M> {
    /// How many steps are done: before the optimiser, those before this step; after it, this one
    /// too.
    pub at: StepInfo,
    /// The model and its optimisers; rows are edited here.
    pub model: &'a mut Optimized<M>,
    /// Gradients of the fields; empty after the step.
    pub gradients: &'a mut FieldGradients,
    /// The training views of the step; empty after it.
    pub screen: &'a [ScreenView],
    /// How the model is rendered in this run, at its highest degree of spherical harmonics.
    pub settings: RenderSettings,
    /// All training views, to render others than those of the step.
    pub views: &'a dyn TrainingViews,
}

/// The views that a run trains on.
pub trait TrainingViews {
    /// How many there are.
    fn count(&self) -> usize;

    /// The camera of a view, relative to the model's origin.
    fn camera(&self, view: usize) -> CameraTensors;

    /// The photo of a view, `[1, H, W, 3]` in [0, 1].
    ///
    /// # Errors
    /// When it is not in memory and cannot be read.
    fn photo(&self, view: usize) -> Result<Tensor<4>, OpError>;
}

/// Counts of a change of rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Refinement {
    /// Gaussians that were duplicated.
    pub cloned: usize,
    /// Gaussians that were replaced by two smaller ones.
    pub split: usize,
    /// Gaussians that were removed.
    pub pruned: usize,
    /// Gaussians that were moved to where others are.
    pub relocated: usize,
    /// Whether opacities were reset.
    pub reset: bool,
}

/// Density control and whatever else changes a run from outside of its loss. Every method but
/// [`after_step`](Self::after_step) has a default that changes nothing.
///
/// ```
/// use splat_model::strategy::{Refinement, StepContext, Strategy};
/// use splat_model::{RowEdit, SplatModel};
/// use splat_model::ops::OpError;
///
/// /// Removes what is nearly transparent every hundred steps, and never adds anything.
/// struct Prune;
///
/// impl<M: SplatModel> Strategy<M> for Prune {
///     fn after_step(&mut self, context: &mut StepContext<M>) -> Result<Option<Refinement>, OpError> {
///         if !context.at.step.is_multiple_of(100) {
///             return Ok(None);
///         }
///         let [logits] = context.model.read(["opacity_logits"])?;
///         let mut edit = RowEdit::identity(logits.len());
///         edit.retain(|row| logits[row] > -5.0);
///         let pruned = logits.len() - edit.len();
///         if pruned > 0 && !edit.is_empty() {
///             context.model.edit_rows(&edit)?;
///         }
///         Ok(Some(Refinement { pruned, ..Refinement::default() }))
///     }
/// }
/// ```
pub trait Strategy<M: SplatModel>: Send {
    /// Its name in a checkpoint: a run resumes with the strategy that it began with. Default:
    /// the type's name.
    fn name(&self) -> String {
        core::any::type_name::<Self>().to_owned()
    }

    /// Checks, before the run, that it can work with the settings that it has on a model of these
    /// fields.
    ///
    /// # Errors
    /// The problem, in one line.
    fn check(&self, _fields: &[Field]) -> Result<(), String> {
        Ok(())
    }

    /// The settings of the first Gaussians, given those of the run.
    fn first_gaussians(&self, settings: &InitSettings) -> InitSettings {
        settings.clone()
    }

    /// By what photos are divided at a step, if not by what the run's settings say.
    fn photo_factor(&self, _at: &StepInfo) -> Option<u32> {
        None
    }

    /// Screen gradients needed at a step.
    fn screen_wants(&self, _at: &StepInfo) -> ScreenWants {
        ScreenWants::nothing()
    }

    /// Which rows it needs around a step. Where it does not need all, the step may be one of the
    /// rows alone that its views may see, which calls [`sparse_step`](Self::sparse_step) in place
    /// of [`before_step`](Self::before_step); a strategy that adds terms to the loss always has
    /// all. Default: all.
    fn rows_needed(&self, _at: &StepInfo) -> RowsNeeded {
        RowsNeeded::All
    }

    /// Called in a step of some rows, after the backward pass and before the optimiser. Gradients
    /// may be read and changed.
    ///
    /// # Errors
    /// As those of the ops that it uses.
    fn sparse_step(&mut self, _step: &mut SparseStep) -> Result<(), OpError> {
        Ok(())
    }

    /// Names of the terms that [`loss_terms`](Self::loss_terms) adds to the loss.
    fn loss_term_names(&self) -> Vec<String> {
        Vec::new()
    }

    /// Terms added to the loss: one for each name, each of shape `[1]`, already weighted.
    ///
    /// # Errors
    /// As those of the ops that it uses.
    fn loss_terms(&self, _pass: &Pass<M>) -> Result<Vec<Tensor<1>>, OpError> {
        Ok(Vec::new())
    }

    /// How the optimiser treats a field at a step.
    fn field_step(&self, _at: &StepInfo, _field: &Field) -> FieldStep {
        FieldStep::Step(1.0)
    }

    /// Called after the backward pass and before the optimiser: gradients may be read and changed.
    /// Rows may not be edited here, because the gradients belong to the rows that there are.
    ///
    /// # Errors
    /// As those of the ops that it uses.
    fn before_step(&mut self, _context: &mut StepContext<M>) -> Result<(), OpError> {
        Ok(())
    }

    /// Called after the optimiser, except after the last step of a run: what it would add would
    /// never be trained. Returns what was done where it was time to do something.
    ///
    /// # Errors
    /// As those of the ops that it uses.
    fn after_step(&mut self, context: &mut StepContext<M>) -> Result<Option<Refinement>, OpError>;

    /// State to keep in a checkpoint: numbers, and tensors of floats, which are kept in single
    /// precision and must be finite.
    ///
    /// # Errors
    /// When the device fails.
    fn save(&self) -> Result<StateRecord, OpError> {
        Ok(StateRecord::default())
    }

    /// Puts back what [`save`](Self::save) gave, for a model of `rows` Gaussians.
    ///
    /// # Errors
    /// The problem with the record, in one line.
    fn restore(
        &mut self,
        _record: StateRecord,
        _rows: usize,
        _device: &Device,
    ) -> Result<(), String> {
        Ok(())
    }
}

/// Checks that a model has the fields that the strategies of this crate edit, for a strategy of
/// this name.
fn check_fields(strategy: &str, fields: &[Field]) -> Result<(), String> {
    let needed = ["means", "log_scales", "quats", "opacity_logits"];
    let has = |name: &&str| fields.iter().any(|field| field.name == **name);
    match needed.iter().find(|name| !has(name)) {
        Some(name) => Err(format!("{strategy} needs a field `{name}`")),
        None => Ok(()),
    }
}
