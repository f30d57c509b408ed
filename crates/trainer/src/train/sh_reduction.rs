//! Lower degrees of spherical harmonics, once in a run, where colours hardly depend on the view.

use splat_model::strategy::{RunSchedule, StepInfo};
use splat_model::{CameraTensors, OwnedRows, SH_COEFFICIENTS, SplatModel, reduce_sh_degrees};
use splat_ops::{SH_DEGREE_MAX, sh_coefficient_count};
use tracing::trace_span;

use super::trainer::{Trainer, hook_view};
use super::{ShReduced, TrainError, TrainSettings, Warning, sh_schedule};

/// Checks, before the run, that degrees of a model can be lowered.
pub(super) fn check<M: SplatModel>(model: &M) -> Result<(), TrainError> {
    let all = sh_coefficient_count(SH_DEGREE_MAX) as u32 - 1;
    let all = OwnedRows::of_counts(SH_COEFFICIENTS, vec![all; model.count()]);
    let kept = model.clone().keep_owned_rows(&all);
    kept.map_err(|error| {
        TrainError::Setup(format!(
            "`sh_reduction` is set, and the model has no degrees to lower: {error}"
        ))
    })
}

/// Whether the reduction is due after the step `at`: a share of the run has passed, and the highest
/// degree has been trained. What was not trained yet is zero, and would be dropped.
fn is_due(config: &TrainSettings, at: &StepInfo, photos: usize) -> bool {
    let Some(settings) = config.sh_reduction else {
        return false;
    };
    let trained = sh_schedule::degree(config, at, photos);
    at.step as f64 >= settings.at * config.steps as f64
        && trained >= config.init.sh_degree.min(SH_DEGREE_MAX)
        && at.step < config.steps
}

/// A warning if the settings ask for a reduction that this run, of so many photos, is too short
/// for.
pub(super) fn never_due(
    config: &TrainSettings,
    run: RunSchedule,
    photos: usize,
) -> Option<Warning> {
    let last = StepInfo {
        step: config.steps.saturating_sub(1),
        run,
    };
    let never = config.sh_reduction.is_some() && !is_due(config, &last, photos);
    never.then_some(Warning::ShReductionNeverDue)
}

impl<M: SplatModel> Trainer<M> {
    /// Lowers the degrees of Gaussians after the step at which it is due, and not again.
    pub(super) fn reduce_sh_degrees(&mut self) -> Result<(), TrainError> {
        let step = self.state.step;
        let Some(settings) = self.config.sh_reduction else {
            return Ok(());
        };
        let at = StepInfo {
            step,
            run: self.schedule,
        };
        let train = &self.capture.split.train;
        let is_due = is_due(&self.config, &at, train.len());
        if !is_due || self.state.history.sh_reduction.is_some() {
            return Ok(());
        }
        let _span = trace_span!("degrees").entered();
        let render = self.render_settings(&at);
        let origin = self.state.model.origin();
        let (capture, hooks, device) = (&self.capture, &self.state.hooks, &self.device);
        let cameras = train.iter().enumerate().map(|(training_index, index)| {
            let view = &capture.views[*index];
            let camera = view.camera().relative_to(origin);
            let cameras = CameraTensors::from_camera(&camera, device);
            hooks.cameras(&hook_view(training_index, view), cameras)
        });
        let model = self.state.model.whole();
        let gaussians = reduce_sh_degrees(model, cameras, &render, &settings)?;
        self.state.history.sh_reduction = Some(ShReduced { step, gaussians });
        Ok(())
    }
}
