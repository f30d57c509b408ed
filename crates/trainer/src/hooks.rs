//! Modules that ride along with a run: they change cameras, backgrounds or pictures, and have
//! optimisers of their own.

use std::any::Any;

use burn::tensor::{Device, Gradients, Tensor};
use splat_model::CameraTensors;
use splat_model::optimizer::StateRecord;
use splat_model::strategy::StepInfo;
use splat_ops::{OpError, Rendered};

/// What a view is rendered for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// To be trained on.
    Training,
    /// To be scored: nothing was learned about this view.
    HeldOut,
}

/// The view that a [`Hook`] is asked about.
#[derive(Debug, Clone, Copy)]
pub struct HookView<'a> {
    /// Index among the views that are trained on; none of a view that is held out.
    pub training_index: Option<usize>,
    /// Name of its photo.
    pub name: &'a str,
    /// What for.
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
    /// What a checkpoint calls it; no two hooks of a run share a name.
    fn name(&self) -> &str;

    /// The cameras to render with.
    ///
    /// # Errors
    /// As those of the ops that it uses.
    fn cameras(&self, _view: &HookView, cameras: CameraTensors) -> Result<CameraTensors, OpError> {
        Ok(cameras)
    }

    /// The colour behind the scene, `[C, 3]`, if this hook has one; the first hook that returns one
    /// wins.
    ///
    /// # Errors
    /// As those of the ops that it uses.
    fn background(
        &self,
        _view: &HookView,
        _cameras: &CameraTensors,
    ) -> Result<Option<Tensor<2>>, OpError> {
        Ok(None)
    }

    /// The picture that is compared with the photo, see [`Rendered::with_image`].
    ///
    /// # Errors
    /// As those of the ops that it uses.
    fn image(&self, _view: &HookView, rendered: Rendered) -> Result<Rendered, OpError> {
        Ok(rendered)
    }

    /// Called after the backward pass: takes its gradients and steps.
    ///
    /// # Errors
    /// As those of the ops that it uses.
    fn step(&mut self, _gradients: &mut Gradients, _at: &StepInfo) -> Result<(), OpError> {
        Ok(())
    }

    /// What a checkpoint must keep of it.
    ///
    /// # Errors
    /// When the device fails.
    fn save(&self) -> Result<StateRecord, OpError> {
        Ok(StateRecord::default())
    }

    /// Puts back what [`save`](Self::save) gave.
    ///
    /// # Errors
    /// What is wrong with it, in a line.
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
