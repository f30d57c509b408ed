//! Progress and result of a run.

use std::any::Any;
use std::time::Duration;

use burn::tensor::Device;
use splat_data::{Camera, Capture, SceneScale, SceneSettings, SplatData, View};
use splat_model::{Gaussians, RenderSettings, SplatModel};
use splat_ops::OpError;

use super::checkpoint::RunRecord;
use super::state::State;
use super::{Checkpoint, CheckpointError, History};
use crate::calibration::{AlignedScores, Aligning, RefineIntrinsics, RefinePoses};
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
    /// Time spent in steps so far, over all sessions of the run; measuring held-out views and
    /// saving are not part of it.
    pub elapsed: Duration,
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

    /// Cameras of all views of the run's capture as calibration has refined them, in the order of
    /// the views; others as they were. Poses of held-out views are those of the capture.
    ///
    /// # Errors
    /// When the device fails.
    pub fn cameras(&self, capture: &Capture) -> Result<Vec<Camera>, OpError> {
        let mut cameras: Vec<Camera> = capture.views.iter().map(View::camera).collect();
        if let Some(intrinsics) = self.hook::<RefineIntrinsics>() {
            for (view, camera) in capture.views.iter().zip(&mut cameras) {
                *camera = intrinsics.refined(&view.name, camera)?;
            }
        }
        if let Some(poses) = self.hook::<RefinePoses>() {
            let trained = &capture.split.train;
            let before: Vec<Camera> = trained.iter().map(|index| cameras[*index]).collect();
            for (index, camera) in trained.iter().zip(poses.refined(&before)?) {
                cameras[*index] = camera;
            }
        }
        Ok(cameras)
    }

    /// Scores views whose poses are first aligned with the scene, in so many steps each; see
    /// [`align_pose`](crate::calibration::align_pose). Other changes by hooks are included.
    ///
    /// # Errors
    /// When an op refuses its input, or the device fails.
    pub fn evaluate_aligned(
        &self,
        views: &[&View],
        device: &Device,
        steps: usize,
    ) -> Result<AlignedScores, OpError> {
        let scene = self.settings.scene_scale.and_then(SceneScale::new);
        let scene = scene.unwrap_or_else(|| self.to_data().scene_scale());
        let aligning = Aligning {
            settings: &self.render_settings,
            scene,
            device,
            steps,
            hooks: &self.state.hooks,
        };
        let mut aligned = Vec::with_capacity(views.len());
        for view in views {
            let camera = aligning.align(&self.model, view)?;
            aligned.push(view.with_pose(&camera));
        }
        let views: Vec<&View> = aligned.iter().collect();
        let scores = self.evaluate(&views, device, |_, _| {})?;
        let cameras = aligned.iter().map(View::camera).collect();
        Ok(AlignedScores { scores, cameras })
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
