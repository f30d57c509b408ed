//! Progress and result of a run.

use std::any::Any;
use std::time::Duration;

use burn::tensor::Device;
use splat_data::{SceneSettings, SplatData, View};
use splat_model::{Gaussians, RenderSettings, SplatModel};
use splat_ops::OpError;

use super::checkpoint::RunRecord;
use super::state::State;
use super::{Checkpoint, CheckpointError, History};
use crate::evaluate::{Scores, evaluate_with};
use crate::hooks::Hook;

/// Progress of a run, for display.
#[derive(Debug, Clone, Copy)]
pub struct Progress<'a> {
    /// Steps done.
    pub step: usize,
    /// Steps of the whole run.
    pub steps: usize,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Log so far; losses lag behind by up to [`LOSS_BATCH`](super::LOSS_BATCH) steps.
    pub history: &'a History,
}

/// Result of a run.
pub struct Trained<M: SplatModel = Gaussians> {
    /// The model, without autodiff.
    pub model: M,
    /// The log.
    pub history: History,
    /// Settings that render the model as it was trained, at its highest degree of spherical
    /// harmonics.
    pub render_settings: RenderSettings,
    /// Steps done; fewer than requested if interrupted.
    pub steps: usize,
    /// Time spent in steps, over all sessions of the run.
    pub elapsed: Duration,
    /// Scene settings that reproduce the look in training.
    pub settings: SceneSettings,
    /// The final state, with that of the optimisers.
    pub(super) state: State<M>,
    pub(super) run: RunRecord,
}

impl<M: SplatModel> Trained<M> {
    /// The scene with its render settings. Changes by hooks to cameras, background or image are not
    /// included.
    pub fn to_data(&self) -> SplatData {
        SplatData {
            settings: self.settings.clone(),
            ..self.model.to_data()
        }
    }

    /// The state to resume from: the size of the scene, plus twice that for the optimisers'
    /// moments.
    ///
    /// # Errors
    /// When the device fails.
    pub fn checkpoint(&self) -> Result<Checkpoint, CheckpointError> {
        Checkpoint::of(&self.state, &self.run)
    }

    /// Scores views as the run does for its own curve, hooks included.
    ///
    /// # Errors
    /// When an op refuses its input, or the device fails.
    pub fn evaluate(
        &self,
        views: &[&View],
        device: &Device,
        each: impl FnMut(&View, Vec<f32>),
    ) -> Result<Scores, OpError> {
        let hooks = &self.state.hooks;
        evaluate_with(
            &self.model,
            views,
            &self.render_settings,
            device,
            hooks,
            each,
        )
    }

    /// The first hook of this type, in its trained state.
    pub fn hook<H: Hook>(&self) -> Option<&H> {
        let hooks = self.state.hooks.0.iter();
        hooks
            .map(|hook| -> &dyn Any { hook.as_ref() })
            .find_map(|hook| hook.downcast_ref())
    }
}

impl<M: SplatModel> std::fmt::Debug for Trained<M> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Trained")
            .field("gaussians", &self.model.count())
            .field("steps", &self.steps)
            .field("elapsed", &self.elapsed)
            .finish_non_exhaustive()
    }
}
