//! The steps of a run, with progress, measurements and autosaves.

use splat_data::{Capture, SceneSettings};
use splat_model::SplatModel;
use splat_ops::SH_DEGREE_MAX;

use super::commands::{Next, Snapshot};
use super::trainer::Trainer;
use super::{Checkpoint, Progress, TrainError, Trained, Warning, views, warnings};
use crate::evaluate::evaluate_with;

impl<M: SplatModel> Trainer<M> {
    /// Runs to the last step, or until interrupted.
    ///
    /// Gradients that are not finite never reach the optimiser (see
    /// [`SplatAdam`](splat_model::optimizer::SplatAdam)). A step without a finite loss is therefore
    /// a warning, and an error only if many follow in a row.
    ///
    /// # Errors
    /// When the loss is not finite for 100 steps in a row, or for all of a shorter run, or an op
    /// refuses its input.
    pub fn run(mut self) -> Result<Trained<M>, TrainError> {
        if self.state.step == 0 {
            let splats = self.state.model.model().to_data();
            let found = warnings::capture_checks::inspect(&self.capture, &splats, &self.config);
            found.into_iter().for_each(|warning| self.warn(warning));
        }
        if let Err(error) = self.advance() {
            self.rescue(&error);
            return Err(error);
        }
        Ok(Trained {
            settings: self.scene_settings(),
            model: self.state.model.model().valid(),
            history: self.state.history.clone(),
            render_settings: self
                .config
                .render_settings(SH_DEGREE_MAX, self.schedule.scene_scale),
            steps: self.state.step,
            elapsed: self.state.elapsed,
            state: self.state,
            run: self.record,
        })
    }

    /// Takes the remaining steps, until interrupted or stopped.
    fn advance(&mut self) -> Result<(), TrainError> {
        while self.state.step < self.config.steps {
            match self.watch.commands.next(&self.watch.interrupt) {
                Next::Step => self.watched_step()?,
                Next::Stop => break,
                Next::Save => {
                    self.read_losses()?;
                    self.save();
                }
                // The receiver may be gone.
                Next::Snapshot(to) => drop(to.send(self.snapshot())),
            }
        }
        self.read_losses()
    }

    fn watched_step(&mut self) -> Result<(), TrainError> {
        self.step()?;
        let (step, steps) = (self.state.step, self.config.steps);
        if warnings::loss_checks::is_due(step, steps) {
            self.inspect_losses();
        }
        let measures = |every: usize| step == steps || step.is_multiple_of(every);
        if self.watch.evaluate_every.is_some_and(measures) {
            self.measure_held_out()?;
        }
        self.save_if_due()?;
        (self.watch.on_progress)(Progress {
            step,
            steps,
            gaussians: self.state.model.count(),
            elapsed: self.state.elapsed,
            history: &self.state.history,
        });
        Ok(())
    }

    /// The current scene, with its render settings.
    pub fn snapshot(&self) -> Snapshot {
        let mut scene = self.state.model.model().to_data();
        scene.settings = self.scene_settings();
        Snapshot {
            step: self.state.step,
            scene,
        }
    }

    fn scene_settings(&self) -> SceneSettings {
        SceneSettings {
            scene_scale: Some(self.schedule.scene_scale.length()),
            antialias: Some(self.config.antialias),
            background: Some(self.config.background.unwrap_or_default()),
            ..SceneSettings::default()
        }
    }

    fn save_if_due(&mut self) -> Result<(), TrainError> {
        let autosave = self.watch.autosave.as_ref();
        if autosave.is_some_and(|autosave| autosave.last.elapsed() >= autosave.every) {
            // The losses so far are part of the checkpoint.
            self.read_losses()?;
            self.save();
        }
        Ok(())
    }

    /// Autosaves the current state. On failure it warns and continues.
    fn save(&mut self) {
        let Some(autosave) = &mut self.watch.autosave else {
            return;
        };
        let saved = Checkpoint::of(&self.state, &self.record)
            .and_then(|checkpoint| (autosave.save)(&checkpoint));
        autosave.last = std::time::Instant::now();
        // A failed autosave does not end training. The warning is not part of the history, since it
        // should be repeated after a resume.
        if let Err(error) = saved
            && !autosave.failures.contains(&error.kind())
        {
            autosave.failures.push(error.kind());
            (self.watch.on_warning)(&Warning::NotSaved {
                step: self.state.step,
                reason: error.to_string(),
            });
        }
    }

    /// Saves the state before a failed step, if autosaving is set up and nothing of the step was
    /// done. A loss that is not finite does not replace an earlier state.
    fn rescue(&mut self, error: &TrainError) {
        let diverged = matches!(error, TrainError::NotFinite { .. });
        if self.state.step > 0 && !diverged && !self.in_step {
            // Losses that cannot be read are dropped.
            let _ = self.read_losses();
            self.save();
        }
    }

    fn inspect_losses(&mut self) {
        let course = warnings::loss_checks::Course {
            losses: &self.state.history.losses,
            step: self.state.step,
            steps: self.config.steps,
        };
        let Capture { views, split, .. } = &*self.capture;
        let mut order = views::ViewOrder::new(self.config.seed, split.train.len());
        let name = |view: usize| views[split.train[view]].name.clone();
        // The loss of several views describes none of them individually.
        let views = match self.config.views_per_step {
            1 => split.train.len(),
            _ => 0,
        };
        let found = course.inspect(views, |step| order.at(step), name);
        found.into_iter().for_each(|warning| self.warn(warning));
    }

    /// Issues a warning, unless it was issued before.
    pub(super) fn warn(&mut self, warning: Warning) {
        if let Some(news) = warning.beyond(&self.state.history.warnings) {
            (self.watch.on_warning)(&news);
            self.state.history.warnings.push(news);
        }
    }

    fn measure_held_out(&mut self) -> Result<(), TrainError> {
        let held_out: Vec<_> = self.capture.test_views().collect();
        if held_out.is_empty() {
            return Ok(());
        }
        let settings = self
            .config
            .render_settings(SH_DEGREE_MAX, self.schedule.scene_scale);
        let device = self.device.clone().without_autodiff();
        let model = self.state.model.model().valid();
        let hooks = &self.state.hooks;
        let scores = evaluate_with(&model, &held_out, &settings, &device, hooks, |_, _| {})?;
        let measured = (self.state.step, scores.psnr);
        self.state.history.held_out_psnr.push(measured);
        Ok(())
    }
}
