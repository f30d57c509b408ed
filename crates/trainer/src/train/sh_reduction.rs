//! Lower degrees of spherical harmonics, once in a run, where colours hardly depend on the view.

use splat_model::strategy::StepInfo;
use splat_model::{
    CameraTensors, OwnedRows, RenderSettings, SH_COEFFICIENTS, SplatModel, reduce_sh_degrees,
};
use splat_ops::{SH_DEGREE_MAX, sh_coefficient_count};
use tracing::trace_span;

use super::trainer::{Trainer, hook_view};
use super::{ShReduced, TrainError, sh_schedule};

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

impl<M: SplatModel> Trainer<M> {
    /// Lowers the degrees of Gaussians after the step at which it is due, and not again.
    pub(super) fn reduce_sh_degrees(&mut self) -> Result<(), TrainError> {
        let (step, steps) = (self.state.step, self.config.steps);
        let Some(settings) = self.config.sh_reduction else {
            return Ok(());
        };
        let at = StepInfo {
            step,
            run: self.schedule,
        };
        let train = &self.capture.split.train;
        // What was not trained yet is zero and would be taken for needless.
        let trained = sh_schedule::degree(&self.config, &at, train.len());
        let is_due = step as f64 >= settings.at * steps as f64
            && trained >= self.config.init.sh_degree.min(SH_DEGREE_MAX)
            && step < steps;
        if !is_due || self.state.history.sh_reduction.is_some() {
            return Ok(());
        }
        let _span = trace_span!("degrees").entered();
        let render = RenderSettings {
            sh_degree: SH_DEGREE_MAX,
            ..self.render_settings(&at)
        };
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
