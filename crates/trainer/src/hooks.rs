//! Modules trained beside the model, which change cameras, backgrounds or images and have their own
//! optimisers.

use std::any::Any;

use burn::tensor::{Device, Gradients, Tensor};
use splat_model::CameraTensors;
use splat_model::optimizer::StateRecord;
use splat_model::strategy::StepInfo;
use splat_ops::{OpError, Rendered};

/// Purpose of a render.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// Training.
    Training,
    /// Scoring: nothing was learned about this view.
    HeldOut,
}

/// The view that a [`Hook`] is asked about.
#[derive(Debug, Clone, Copy)]
pub struct HookView<'a> {
    /// Index among the training views; `None` for a held-out view.
    pub training_index: Option<usize>,
    /// Name of its photo.
    pub name: &'a str,
    /// Purpose of the render.
    pub purpose: Purpose,
}

/// A module trained beside the model: poses, exposures, a background. Every method has a default
/// that changes nothing. [`TrainerBuilder::hook`](crate::TrainerBuilder::hook) adds one; hooks are
/// asked in the order in which they were added.
///
/// ```
/// use burn::tensor::Tensor;
/// use splat_model::CameraTensors;
/// use splat_model::ops::OpError;
/// use splat_trainer::{Hook, HookView};
///
/// /// White behind every view.
/// struct White;
///
/// impl Hook for White {
///     fn name(&self) -> &str {
///         "white"
///     }
///     fn background(
///         &self,
///         _: &HookView,
///         cameras: &CameraTensors,
///     ) -> Result<Option<Tensor<2>>, OpError> {
///         let [count, _, _] = cameras.viewmats.dims();
///         Ok(Some(Tensor::ones([count, 3], &cameras.viewmats.device())))
///     }
/// }
/// ```
pub trait Hook: Any + Send {
    /// Name in checkpoints, unique within a run.
    fn name(&self) -> &str;

    /// The cameras to render with.
    ///
    /// # Errors
    /// Those of the ops used.
    fn cameras(&self, _view: &HookView, cameras: CameraTensors) -> Result<CameraTensors, OpError> {
        Ok(cameras)
    }

    /// The background colour, `[C, 3]`, if this hook has one. The first hook that returns one wins.
    ///
    /// # Errors
    /// Those of the ops used.
    fn background(
        &self,
        _view: &HookView,
        _cameras: &CameraTensors,
    ) -> Result<Option<Tensor<2>>, OpError> {
        Ok(None)
    }

    /// The image compared with the photo, see [`Rendered::with_image`].
    ///
    /// # Errors
    /// Those of the ops used.
    fn image(&self, _view: &HookView, rendered: Rendered) -> Result<Rendered, OpError> {
        Ok(rendered)
    }

    /// Called after the backward pass, to take gradients and step.
    ///
    /// # Errors
    /// Those of the ops used.
    fn step(&mut self, _gradients: &mut Gradients, _at: &StepInfo) -> Result<(), OpError> {
        Ok(())
    }

    /// State to keep in a checkpoint.
    ///
    /// # Errors
    /// When the device fails.
    fn save(&self) -> Result<StateRecord, OpError> {
        Ok(StateRecord::default())
    }

    /// Restores the output of [`save`](Self::save).
    ///
    /// # Errors
    /// The problem, in one line.
    fn restore(&mut self, _record: StateRecord, _device: &Device) -> Result<(), String> {
        Ok(())
    }
}

/// The hooks of a run.
#[derive(Default)]
pub(crate) struct Hooks(pub(crate) Vec<Box<dyn Hook>>);

impl Hooks {
    pub(crate) fn cameras(
        &self,
        view: &HookView,
        cameras: CameraTensors,
    ) -> Result<CameraTensors, OpError> {
        self.0
            .iter()
            .try_fold(cameras, |cameras, hook| hook.cameras(view, cameras))
    }

    pub(crate) fn background(
        &self,
        view: &HookView,
        cameras: &CameraTensors,
    ) -> Result<Option<Tensor<2>>, OpError> {
        for hook in &self.0 {
            if let Some(background) = hook.background(view, cameras)? {
                return Ok(Some(background));
            }
        }
        Ok(None)
    }

    pub(crate) fn image(&self, view: &HookView, rendered: Rendered) -> Result<Rendered, OpError> {
        self.0
            .iter()
            .try_fold(rendered, |rendered, hook| hook.image(view, rendered))
    }

    pub(crate) fn step(&mut self, gradients: &mut Gradients, at: &StepInfo) -> Result<(), OpError> {
        self.0
            .iter_mut()
            .try_for_each(|hook| hook.step(gradients, at))
    }
}
