//! Training: render a view, measure the loss, step the optimiser, control the density; repeat
//! (3DGS sections 5 and 7.1).

mod checkpoint;
mod coarse;
mod config;
mod fingerprint;
mod history;
mod loss;
pub(crate) mod views;
mod warnings;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use burn::module::Module;
use burn::optim::{GradientsParams, ModuleOptimizer};
use burn::tensor::{Device, Tensor, Transaction};
use splat_data::{SceneSettings, SplatData};
use splat_model::density::{AdaptiveDensity, RunShape};
use splat_model::ops::device::keep_awake;
use splat_model::ops::{OpError, SH_DEGREE_MAX};
use splat_model::{
    CameraTensors, EditLog, Gaussians, InitError, RenderSettings, SceneScale, project_gaussians,
    render_projected, splat_optimizer, splats_from_points,
};
use tracing::trace_span;

use crate::evaluate::evaluate;
use crate::photo::levels;
use checkpoint::RunRecord;
use fingerprint::Fingerprint;
use splat_data::{Capture, CaptureError, View};

#[doc(hidden)]
pub use checkpoint::expected_checksum;
pub use checkpoint::{Checkpoint, CheckpointError};
pub use config::TrainConfig;
pub use history::{History, LossRecord};
pub use loss::{IntoLoss, LossTerms, TargetView};
pub use warnings::Warning;

/// Why a run could not go on.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// The capture has nothing to train on.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// The points cannot start a scene.
    #[error("{capture}: {source}")]
    Init {
        /// The capture's folder.
        capture: PathBuf,
        /// What is wrong with them.
        source: InitError,
    },
    /// The scene is too small or too large for single precision.
    #[error(
        "{capture}: the scene is {size:.1e} units large, single precision has room for 1e-15 to 1e10; give cameras and points in another unit"
    )]
    SceneSize {
        /// The capture's folder.
        capture: PathBuf,
        /// Its size, see [`SceneScale`].
        size: f64,
    },
    /// A setting is out of range.
    #[error("configuration: {0}")]
    Config(String),
    /// The checkpoint to resume from is not usable.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// An op refused its input.
    #[error(transparent)]
    Op(#[from] OpError),
    /// The loss has no term, or does not depend on what was rendered.
    #[error("the loss {0}")]
    Loss(&'static str),
    /// The loss stays NaN or infinite.
    #[error(
        "step {step}: the loss is {value} on view {view}, and was not finite for {in_a_row} steps in a row; lower the learning rates, or look at the photos, their cameras and the loss"
    )]
    NotFinite {
        /// The last of these steps, from 1.
        step: usize,
        /// Name of its photo.
        view: String,
        /// Its loss.
        value: f32,
        /// How many they are.
        in_a_row: usize,
    },
}

/// Where a run stands, for whoever shows it.
#[derive(Debug, Clone, Copy)]
pub struct Progress<'a> {
    /// Steps done.
    pub step: usize,
    /// Steps of the whole run.
    pub steps: usize,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// What was logged so far; losses lag behind by up to [`LOSS_BATCH`] steps.
    pub history: &'a History,
}

/// Losses are read back from the device in batches of this many steps.
pub const LOSS_BATCH: usize = 10;

/// A run ends after this many steps in a row without a finite loss: no single photo is the cause then.
const NOT_FINITE_LIMIT: usize = 100;

/// What a run leaves.
pub struct Trained {
    /// The model.
    pub gaussians: Gaussians,
    /// What was logged.
    pub history: History,
    /// How to render the model as it was trained, at its highest degree of spherical harmonics.
    pub render_settings: RenderSettings,
    /// Steps done; fewer than asked for when interrupted.
    pub steps: usize,
    /// Time spent in steps, over all sessions of the run.
    pub elapsed: Duration,
    /// How the scene must be rendered to look as it did in training.
    pub settings: SceneSettings,
    /// As it was trained, with the optimiser's state.
    state: (Gaussians, State, RunRecord),
}

impl Trained {
    /// The scene, with the settings that it must be rendered with.
    pub fn to_data(&self) -> SplatData {
        SplatData {
            settings: self.settings.clone(),
            ..self.gaussians.to_data()
        }
    }

    /// The state to resume from. It is as large again as the scene, and the optimiser's moments twice that.
    ///
    /// # Errors
    /// When the optimiser's state cannot be packed.
    pub fn checkpoint(&self) -> Result<Checkpoint, CheckpointError> {
        let (gaussians, state, run) = &self.state;
        Checkpoint::of(gaussians, state, run)
    }
}

impl std::fmt::Debug for Trained {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Trained")
            .field("gaussians", &self.gaussians.len())
            .field("steps", &self.steps)
            .field("elapsed", &self.elapsed)
            .finish_non_exhaustive()
    }
}

/// Builds a [`Trainer`].
pub struct TrainerBuilder {
    capture: Option<Arc<Capture>>,
    config: TrainConfig,
    device: Device,
    loss: Option<LossTerms>,
    interrupt: Arc<AtomicBool>,
    resume: Option<Checkpoint>,
    evaluate_every: Option<usize>,
    autosave: Option<Autosave>,
    on_progress: Box<dyn FnMut(Progress)>,
    on_warning: Box<dyn FnMut(&Warning)>,
}

/// Keeps the state of a run from time to time.
struct Autosave {
    every: Duration,
    last: Instant,
    save: Box<SaveCheckpoint>,
    /// Kinds of failure that were told.
    failures: Vec<String>,
}

/// Puts a checkpoint where it outlives the process.
type SaveCheckpoint = dyn FnMut(&Checkpoint) -> Result<(), CheckpointError>;

impl TrainerBuilder {
    /// The photos to train on.
    pub fn capture(mut self, capture: impl Into<Arc<Capture>>) -> Self {
        self.capture = Some(capture.into());
        self
    }

    /// Settings; the defaults are those of gsplat.
    pub fn config(mut self, config: TrainConfig) -> Self {
        self.config = config;
        self
    }

    /// Where to compute. Default: Burn's default device.
    pub fn device(mut self, device: Device) -> Self {
        self.device = device;
        self
    }

    /// What to minimise: a closure `|view, rendered| -> Result<Tensor<1>, OpError>` or
    /// [`LossTerms`]. Default: [`LossTerms::l1_ssim`].
    pub fn loss(mut self, loss: impl IntoLoss) -> Self {
        self.loss = Some(loss.into_loss());
        self
    }

    /// The run ends after the step during which this becomes true.
    pub fn interrupt(mut self, flag: Arc<AtomicBool>) -> Self {
        self.interrupt = flag;
        self
    }

    /// Goes on from a checkpoint instead of the capture's points. The capture must be that of the checkpoint, and so
    /// must the settings, see [`Checkpoint::check_settings`].
    pub fn resume(mut self, checkpoint: Checkpoint) -> Self {
        self.resume = Some(checkpoint);
        self
    }

    /// Measures held-out PSNR every so many steps, for the curves. Default: never.
    pub fn evaluate_every(mut self, steps: usize) -> Self {
        self.evaluate_every = Some(steps.max(1));
        self
    }

    /// Calls `save` every so often, so that a crash loses no more than that much time. When it fails the run goes on
    /// with a warning, one for each kind of failure. Default: never.
    pub fn autosave(
        mut self,
        every: Duration,
        save: impl FnMut(&Checkpoint) -> Result<(), CheckpointError> + 'static,
    ) -> Self {
        self.autosave = Some(Autosave {
            every,
            last: Instant::now(),
            save: Box::new(save),
            failures: Vec::new(),
        });
        self
    }

    /// Called after every step.
    pub fn on_progress(mut self, callback: impl FnMut(Progress) + 'static) -> Self {
        self.on_progress = Box::new(callback);
        self
    }

    /// Called when something looks wrong; [`History::warnings`] keeps what is wrong with the run itself.
    pub fn on_warning(mut self, callback: impl FnMut(&Warning) + 'static) -> Self {
        self.on_warning = Box::new(callback);
        self
    }

    /// Checks everything and makes the first Gaussians.
    ///
    /// # Errors
    /// When there is no capture, nothing in it to train on, a setting is out of range, or the checkpoint to resume from
    /// is another run's.
    pub fn build(mut self) -> Result<Trainer, TrainError> {
        if let Some(problem) = self.config.problem() {
            return Err(TrainError::Config(problem));
        }
        let capture = self
            .capture
            .ok_or_else(|| TrainError::Config("no capture was given".into()))?;
        capture.check_trainable()?;
        let loss = self
            .loss
            .unwrap_or_else(|| LossTerms::l1_ssim(self.config.ssim_weight));
        let cameras: Vec<_> = capture.views.iter().map(View::camera).collect();
        let points: Vec<[f64; 3]> = capture.points.iter().map(|point| point.position).collect();
        let run = RunShape {
            steps: self.config.steps,
            scene_scale: SceneScale::of_capture(&cameras, &points),
            seed: self.config.seed,
        };
        if !run.scene_scale.is_in_range() {
            return Err(TrainError::SceneSize {
                capture: capture.root.clone(),
                size: run.scene_scale.length(),
            });
        }
        let device = self.device.without_autodiff().autodiff();
        let mut record = RunRecord {
            capture: Fingerprint::of(&capture),
            config: self.config.clone(),
            changes: Vec::new(),
        };
        let mut config = self.config;
        let most = config.density.max_gaussians;
        config.density.max_gaussians = most.or_else(|| Some(worthwhile_gaussians(&capture)));
        let mut state = State::new(&config, run, &loss);
        let gaussians = match self.resume {
            Some(checkpoint) => {
                let views = checkpoint.check_run(&record, &state.history.terms)?;
                if !views.is_empty() {
                    (self.on_warning)(&Warning::PhotosChanged { views });
                }
                record.changes = checkpoint.changes_with(&record.config);
                checkpoint.restore(&mut state, &device)?
            }
            None => {
                let origin = run.scene_scale.origin(&cameras);
                first_gaussians(&capture, &config, run, origin, &device)?
            }
        };
        if state.history.counts.is_empty() {
            state.history.counts.push((0, gaussians.len()));
        }
        Ok(Trainer {
            views: views::ViewOrder::new(config.seed, capture.split.train.len()),
            capture,
            config,
            device,
            loss,
            run,
            interrupt: self.interrupt,
            evaluate_every: self.evaluate_every,
            autosave: self.autosave,
            on_progress: self.on_progress,
            on_warning: self.on_warning,
            gaussians,
            state,
            record,
            unread: Vec::new(),
            coarse: coarse::CoarseViews::default(),
        })
    }
}

/// Beyond so many Gaussians growth is not worth its time, see [`TrainConfig::density`].
fn worthwhile_gaussians(capture: &Capture) -> usize {
    let pixels = |view: &usize| {
        let view = &capture.views[*view];
        view.width as usize * view.height as usize
    };
    let photos = capture.split.train.iter().map(pixels);
    (photos.clone().sum::<usize>() / 100).max(photos.max().unwrap_or(0) * 7 / 10)
}

fn first_gaussians(
    capture: &Capture,
    config: &TrainConfig,
    run: RunShape,
    origin: [f64; 3],
    device: &Device,
) -> Result<Gaussians, TrainError> {
    let points = &capture.points;
    let positions: Vec<_> = points
        .iter()
        .map(|p| std::array::from_fn(|axis| (p.position[axis] - origin[axis]) as f32))
        .collect();
    let colors: Vec<_> = points.iter().map(|p| p.color).collect();
    let splats = splats_from_points(&positions, &colors, run.scene_scale, &config.init);
    let mut splats = splats.map_err(|source| TrainError::Init {
        capture: capture.root.clone(),
        source,
    })?;
    splats.origin = origin;
    Ok(Gaussians::from_data(&splats, device))
}

/// What changes during a run, apart from the Gaussians themselves.
struct State {
    optimizer: ModuleOptimizer,
    edits: [EditLog; 6],
    density: AdaptiveDensity,
    history: History,
    /// Steps done.
    step: usize,
    elapsed: Duration,
}

impl State {
    fn new(config: &TrainConfig, run: RunShape, loss: &LossTerms) -> Self {
        let (optimizer, edits) = splat_optimizer(config.adam_rows(), run.scene_scale);
        Self {
            optimizer,
            edits,
            density: AdaptiveDensity::new(config.density.clone(), run),
            history: History {
                terms: loss.names().map(str::to_owned).collect(),
                ..History::default()
            },
            step: 0,
            elapsed: Duration::ZERO,
        }
    }
}

/// A loss that is still on the device.
struct UnreadLoss {
    step: usize,
    view: usize,
    /// Total, then the terms.
    values: Vec<Tensor<1>>,
}

/// A training run.
pub struct Trainer {
    capture: Arc<Capture>,
    config: TrainConfig,
    device: Device,
    loss: LossTerms,
    run: RunShape,
    views: views::ViewOrder,
    interrupt: Arc<AtomicBool>,
    evaluate_every: Option<usize>,
    autosave: Option<Autosave>,
    on_progress: Box<dyn FnMut(Progress)>,
    on_warning: Box<dyn FnMut(&Warning)>,
    gaussians: Gaussians,
    state: State,
    record: RunRecord,
    unread: Vec<UnreadLoss>,
    coarse: coarse::CoarseViews,
}

impl Trainer {
    /// Begins to describe a run.
    pub fn builder() -> TrainerBuilder {
        TrainerBuilder {
            capture: None,
            config: TrainConfig::default(),
            device: Device::default(),
            loss: None,
            interrupt: Arc::default(),
            resume: None,
            evaluate_every: None,
            autosave: None,
            on_progress: Box::new(|_| {}),
            on_warning: Box::new(|_| {}),
        }
    }

    /// Runs to the last step, or until interrupted.
    ///
    /// A gradient that is not finite never reaches the optimiser (see [`SplatAdam`](splat_model::SplatAdam)), so a
    /// step whose loss is not is a warning, and an error only when many come in a row.
    ///
    /// # Errors
    /// When the loss is not finite for 100 steps in a row, or for the whole of a shorter run, or an op refuses what it is
    /// given.
    pub fn run(mut self) -> Result<Trained, TrainError> {
        if self.state.step == 0 {
            let found = warnings::start::inspect(&self.capture, &self.gaussians, &self.config);
            found.into_iter().for_each(|warning| self.warn(warning));
        }
        if let Err(error) = self.advance() {
            self.rescue(&error);
            return Err(error);
        }
        Ok(Trained {
            settings: SceneSettings {
                scene_scale: Some(self.run.scene_scale.length()),
                antialias: Some(self.config.antialias),
                background: Some(self.config.background.unwrap_or_default()),
                ..SceneSettings::default()
            },
            gaussians: self.gaussians.valid(),
            history: self.state.history.clone(),
            render_settings: self
                .config
                .render_settings(SH_DEGREE_MAX, self.run.scene_scale),
            steps: self.state.step,
            elapsed: self.state.elapsed,
            state: (self.gaussians, self.state, self.record),
        })
    }

    /// Takes the steps that are left, until interrupted.
    fn advance(&mut self) -> Result<(), TrainError> {
        while self.state.step < self.config.steps && !self.should_stop() {
            self.step()?;
            let last = self.state.step == self.config.steps;
            if warnings::course::is_due(self.state.step, self.config.steps) {
                self.inspect_losses();
            }
            if self
                .evaluate_every
                .is_some_and(|every| last || self.state.step.is_multiple_of(every))
            {
                self.measure_held_out()?;
            }
            self.save_if_due()?;
            (self.on_progress)(Progress {
                step: self.state.step,
                steps: self.config.steps,
                gaussians: self.gaussians.len(),
                history: &self.state.history,
            });
        }
        self.read_losses()?;
        Ok(())
    }

    /// Keeps what was done before a step that failed, if there is a place for it. A loss that is not finite is no reason
    /// to replace a state of before it.
    fn rescue(&mut self, error: &TrainError) {
        let diverged = matches!(error, TrainError::NotFinite { .. });
        if self.state.step > 0 && self.is_at_rest() && !diverged {
            // What cannot be read any more is not what is to be kept.
            let _ = self.read_losses();
            self.save();
        }
    }

    fn should_stop(&self) -> bool {
        self.interrupt.load(Ordering::Relaxed) && self.is_at_rest()
    }

    /// At a point that a checkpoint can hold: the means' moments, which are stepped with all others,
    /// have followed every edit.
    fn is_at_rest(&self) -> bool {
        !self.state.edits[0].is_pending()
    }

    fn save_if_due(&mut self) -> Result<(), TrainError> {
        let due = |autosave: &Autosave| autosave.last.elapsed() >= autosave.every;
        if !self.autosave.as_ref().is_some_and(due) || !self.is_at_rest() {
            return Ok(());
        }
        // The losses up to here are part of the checkpoint.
        self.read_losses()?;
        self.save();
        Ok(())
    }

    /// Keeps the present state where the run's are kept. Says if it cannot be, and goes on.
    fn save(&mut self) {
        let Some(autosave) = &mut self.autosave else {
            return;
        };
        let saved = Checkpoint::of(&self.gaussians, &self.state, &self.record)
            .and_then(|checkpoint| (autosave.save)(&checkpoint));
        autosave.last = Instant::now();
        // Training is worth more than what could not be kept of it. Not part of the history: when the run is resumed
        // it is news again.
        if let Err(error) = saved
            && !autosave.failures.contains(&error.kind())
        {
            autosave.failures.push(error.kind());
            (self.on_warning)(&Warning::NotSaved {
                step: self.state.step,
                reason: error.to_string(),
            });
        }
    }

    /// Takes the next step of the run, for whoever drives the loop instead of [`run`](Self::run), which also
    /// watches, measures and keeps what becomes of it.
    ///
    /// # Errors
    /// As those of [`run`](Self::run).
    pub fn step(&mut self) -> Result<(), TrainError> {
        let _span = trace_span!("step").entered();
        let start = Instant::now();
        keep_awake(&self.device);
        self.update()?;
        let inspects = warnings::course::is_due(self.state.step, self.config.steps);
        if self.unread.len() >= LOSS_BATCH || inspects {
            self.read_losses()?;
        }
        self.state.elapsed += start.elapsed();
        Ok(())
    }

    /// Size of the scene, from which every length of the run follows.
    pub fn scene_scale(&self) -> SceneScale {
        self.run.scene_scale
    }

    /// The Gaussians as they are after the last step.
    pub fn gaussians(&self) -> &Gaussians {
        &self.gaussians
    }

    fn update(&mut self) -> Result<(), TrainError> {
        let step = self.state.step;
        let index = self.capture.split.train[self.views.at(step)];
        let factor = coarse::factor(&self.config, self.run, step);
        let view = self.coarse.view(&self.capture, index, factor);
        let cameras = CameraTensors::from_camera(
            &view.camera().relative_to(self.gaussians.origin),
            &self.device,
        );
        let settings = self
            .config
            .render_settings(self.sh_degree(step), self.run.scene_scale);

        let render = trace_span!("render").entered();
        let mut projected = project_gaussians(&self.gaussians, &cameras, &settings)?;
        let mut probe = None;
        if self.state.density.observes(step) {
            let (probed, leaf) = projected.with_screen_probe();
            (projected, probe) = (probed, Some(leaf));
        }
        let rendered = render_projected(&self.gaussians, &projected, &cameras, &settings)?;
        drop(render);
        let levels = trace_span!("photo").in_scope(|| levels(&view, &self.device));
        let target = TargetView::new(&view.name, levels, &cameras, step);
        let evaluated = trace_span!("loss").in_scope(|| self.loss.evaluate(&target, &rendered))?;
        let Some((loss, terms)) = evaluated else {
            return Err(TrainError::Loss("has no term"));
        };
        if !loss.is_tracked() {
            return Err(TrainError::Loss("does not depend on the rendered image"));
        }
        let mut grads = trace_span!("backward").in_scope(|| loss.backward());
        let screen_gradient = probe.and_then(|probe| probe.grad_remove(&mut grads));
        if let Some(gradient) = screen_gradient {
            let _density = trace_span!("density").entered();
            self.state.density.observe(gradient, &projected)?;
        }
        // The optimiser needs nothing of the picture.
        drop((projected, rendered, target));
        let optimizer = trace_span!("optimizer").entered();
        let grads = GradientsParams::from_grads(grads, &self.gaussians);
        let rates = self
            .config
            .rates
            .at(step, self.config.steps, self.run.scene_scale);
        // Out of its place: the optimiser writes into memory that nothing else holds, and copies the rest.
        let gaussians = std::mem::replace(&mut self.gaussians, Gaussians::empty(&self.device));
        self.gaussians = self.state.optimizer.step(rates, gaussians, grads);
        drop(optimizer);

        let mut values = vec![loss.inner()];
        values.extend(terms);
        self.unread.push(UnreadLoss {
            step: step + 1,
            view: index,
            values,
        });
        self.state.step += 1;
        let _density = trace_span!("density").entered();
        // What would be added after the last step would never be trained.
        if self.state.step < self.config.steps {
            self.control_density();
        }
        Ok(())
    }

    fn control_density(&mut self) {
        let gaussians = self.gaussians.clone();
        let State {
            density,
            edits,
            history,
            step,
            ..
        } = &mut self.state;
        let (gaussians, refinement) = density.refine(*step, gaussians, edits);
        self.gaussians = gaussians;
        if refinement.is_some() {
            history.counts.push((*step, self.gaussians.len()));
        }
    }

    fn sh_degree(&self, step: usize) -> usize {
        (step / self.run.milestone(self.config.sh_degree_every)).min(SH_DEGREE_MAX)
    }

    /// Reads all pending losses in one transfer.
    fn read_losses(&mut self) -> Result<(), TrainError> {
        let unread = core::mem::take(&mut self.unread);
        if unread.is_empty() {
            return Ok(());
        }
        let values = unread.iter().flat_map(|loss| loss.values.clone());
        let read = values.fold(Transaction::default(), Transaction::register);
        let read = read.try_execute().map_err(|error| OpError::Device {
            op: "training step",
            what: error.to_string(),
        })?;
        let values = read.into_iter().map(|data| data.convert::<f32>());
        let values: Vec<f32> = values
            .flat_map(|data| data.try_into_vec::<f32>().unwrap_or_default())
            .collect();
        for (loss, values) in unread
            .iter()
            .zip(values.chunks(1 + self.state.history.terms.len()))
        {
            if values[0].is_finite() {
                self.state.history.losses.push(LossRecord {
                    step: loss.step,
                    total: values[0],
                    terms: values[1..].to_vec(),
                });
                continue;
            }
            let view = self.capture.views[loss.view].name.clone();
            let last_finite = self.state.history.losses.last();
            let in_a_row = loss.step - last_finite.map_or(0, |record| record.step);
            if in_a_row >= NOT_FINITE_LIMIT.min(self.config.steps) {
                return Err(TrainError::NotFinite {
                    step: loss.step,
                    view,
                    value: values[0],
                    in_a_row,
                });
            }
            let step = loss.step;
            self.warn(Warning::LossNotFinite { view, step });
        }
        Ok(())
    }

    fn inspect_losses(&mut self) {
        let course = warnings::course::Course {
            losses: &self.state.history.losses,
            step: self.state.step,
            steps: self.config.steps,
        };
        let Capture { views, split, .. } = &*self.capture;
        let mut order = views::ViewOrder::new(self.config.seed, split.train.len());
        let name = |view: usize| views[split.train[view]].name.clone();
        let found = course.inspect(split.train.len(), |step| order.at(step), name);
        found.into_iter().for_each(|warning| self.warn(warning));
    }

    /// Says what looks wrong, unless it was said before.
    fn warn(&mut self, warning: Warning) {
        if let Some(news) = warning.beyond(&self.state.history.warnings) {
            (self.on_warning)(&news);
            self.state.history.warnings.push(news);
        }
    }

    fn measure_held_out(&mut self) -> Result<(), TrainError> {
        let held_out: Vec<&View> = self.capture.test_views().collect();
        if held_out.is_empty() {
            return Ok(());
        }
        let settings = self
            .config
            .render_settings(SH_DEGREE_MAX, self.run.scene_scale);
        let device = self.device.clone().without_autodiff();
        let scores = evaluate(
            &self.gaussians.valid(),
            &held_out,
            &settings,
            &device,
            |_, _| {},
        )?;
        self.state
            .history
            .held_out_psnr
            .push((self.state.step, scores.psnr));
        Ok(())
    }
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use std::cell::RefCell;
    use std::rc::Rc;

    use super::*;
    use splat_data::CaptureOptions;

    fn capture() -> Arc<Capture> {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
        let options = CaptureOptions {
            downscale: 8,
            ..CaptureOptions::default()
        };
        Arc::new(Capture::load(folder.as_ref(), &options).unwrap())
    }

    fn builder() -> TrainerBuilder {
        let config = TrainConfig {
            steps: 240,
            ..TrainConfig::default()
        };
        Trainer::builder()
            .capture(capture())
            .config(config)
            .device(Device::flex())
    }

    /// Growth ends where a setting says, else where the photos do.
    #[test]
    fn the_photos_say_how_many_gaussians_are_worthwhile() {
        let most = |capture: Capture, config: TrainConfig| {
            let trainer = Trainer::builder().capture(Arc::new(capture)).config(config);
            let trainer = trainer.device(Device::flex()).build().unwrap();
            trainer.config.density.max_gaussians
        };
        let config = TrainConfig::default();
        let mut capture = Capture::clone(&capture());
        for view in &mut capture.views {
            (view.width, view.height) = (40, 30);
        }
        capture.split.train.truncate(2);
        assert_eq!(most(capture.clone(), config.clone()), Some(840));
        capture.split.train = [0, 1].repeat(50);
        assert_eq!(most(capture.clone(), config.clone()), Some(1_200));
        let mut config = config;
        config.density.max_gaussians = Some(7);
        assert_eq!(most(capture, config), Some(7));
    }

    /// Interrupted after a refinement and resumed from the file, a run ends with the same scene.
    #[test]
    fn a_resumed_run_goes_on_as_if_it_had_not_stopped() {
        // A quarter of the resolution for 60 steps, and half of it for another 60.
        let builder = || {
            builder().config(TrainConfig {
                steps: 240,
                coarse_halvings: 2,
                coarse_every: 7_500,
                ..TrainConfig::default()
            })
        };
        let whole = builder().build().unwrap().run().unwrap();

        let flag = Arc::new(AtomicBool::new(false));
        let raise = flag.clone();
        let first = builder()
            .interrupt(flag)
            .on_progress(move |state| raise.store(state.step >= 105, Ordering::Relaxed))
            .build()
            .unwrap()
            .run()
            .unwrap();
        assert_eq!(first.steps, 105);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.safetensors");
        first.checkpoint().unwrap().save(&path).unwrap();
        let checkpoint = Checkpoint::load(&path).unwrap();
        let second = builder().resume(checkpoint).build().unwrap().run().unwrap();

        assert_eq!(second.steps, 240);
        assert_eq!(second.history.losses, whole.history.losses);
        assert!(second.gaussians.to_data() == whole.gaussians.to_data());
        // Density control must have been part of it.
        assert_ne!(whole.gaussians.len(), capture().points.len());

        let mut damaged = first.checkpoint().unwrap();
        damaged.drop_row("quats");
        let error = damaged.save(&path).unwrap_err().to_string();
        assert!(error.contains("`quats` has shape"), "{error}");

        // A bit that is lost anywhere is noticed.
        first.checkpoint().unwrap().save(&path).unwrap();
        let whole = std::fs::read(&path).unwrap();
        assert!(Checkpoint::parse(&path, &whole).is_ok());
        for at in (0..whole.len()).step_by(whole.len() / 300) {
            let mut bytes = whole.clone();
            bytes[at] ^= 4;
            let error = Checkpoint::parse(&path, &bytes).unwrap_err().to_string();
            assert!(error.contains("not a usable checkpoint"), "{error}");
            assert!(Checkpoint::parse(&path, &whole[..at]).is_err());
        }

        std::fs::write(&path, b"something else").unwrap();
        let error = Checkpoint::load(&path).unwrap_err().to_string();
        assert!(error.contains("checkpoint.safetensors"), "{error}");
    }

    /// What an autosave kept is where a killed run goes on from, to the same end.
    #[test]
    fn a_killed_run_goes_on_from_its_last_autosave() {
        let kept = Rc::new(RefCell::new(Vec::new()));
        let keep = kept.clone();
        let whole = builder()
            .autosave(Duration::ZERO, move |checkpoint| {
                keep.borrow_mut().push(checkpoint.clone());
                Ok(())
            })
            .build()
            .unwrap()
            .run()
            .unwrap();
        let kept = kept.borrow();
        assert!(kept.len() > 200, "{} checkpoints", kept.len());
        let checkpoint = kept[kept.len() - 30].clone();
        assert!(checkpoint.step() < 240);
        let resumed = builder().resume(checkpoint).build().unwrap().run().unwrap();
        assert_eq!(resumed.history.losses, whole.history.losses);
        assert!(resumed.gaussians.to_data() == whole.gaussians.to_data());
    }

    /// What cannot be kept is told once for each kind of failure, and costs nothing of the run.
    #[test]
    fn a_run_outlives_its_autosaves() {
        let said = Rc::new(RefCell::new(Vec::new()));
        let heard = said.clone();
        let mut count = 0;
        let trained = builder()
            .autosave(Duration::ZERO, move |_| {
                count += 1;
                let kind = match count % 3 {
                    0 => std::io::ErrorKind::StorageFull,
                    1 => std::io::ErrorKind::PermissionDenied,
                    _ => return Ok(()),
                };
                Err(CheckpointError::Io {
                    path: "there".into(),
                    // As where a name differs from time to time.
                    source: std::io::Error::new(kind, format!("attempt {count}")),
                })
            })
            .on_warning(move |warning| heard.borrow_mut().push(warning.to_string()))
            .build()
            .unwrap()
            .run()
            .unwrap();
        assert_eq!(trained.steps, 240);
        let said = said.borrow();
        assert_eq!(said.len(), 2, "{said:?}");
        assert!(said[0].contains("there: attempt 1"), "{said:?}");
        // The next run that goes on from here is to hear of it again.
        assert!(trained.history.warnings.is_empty());
    }

    /// Another run is not gone on with: another capture, other settings, another loss; photos whose pixels alone
    /// changed are named.
    #[test]
    fn a_checkpoint_is_of_one_run() {
        let first = builder()
            .interrupt(Arc::new(AtomicBool::new(true)))
            .build()
            .unwrap()
            .run()
            .unwrap();
        let checkpoint = first.checkpoint().unwrap();
        let refusal = |change: &dyn Fn(TrainerBuilder) -> TrainerBuilder| {
            let built = change(builder().resume(checkpoint.clone())).build();
            built.err().map(|error| error.to_string())
        };
        assert_eq!(refusal(&|builder| builder), None);
        let mut other = Capture::clone(&capture());
        other.split.train.pop();
        let error = refusal(&|builder| builder.capture(Arc::new(other.clone())));
        assert!(error.unwrap().contains("is not used, it was trained on"));
        let mut config = first.state.2.config.clone();
        config.rates.sh0 *= 2.0;
        config.background = Some([1.0; 3]);
        let error = refusal(&|builder| builder.config(config.clone())).unwrap();
        assert!(
            error.contains("background = absent") && error.contains("rates.sh0"),
            "{error}"
        );
        let error = refusal(&|builder| {
            builder.loss(|_: &TargetView, rendered: &splat_model::ops::Rendered| {
                Ok(rendered.alpha().mean())
            })
        });
        assert!(error.unwrap().contains("a loss of the terms"));

        let said = Rc::new(RefCell::new(Vec::new()));
        let heard = said.clone();
        let mut other = Capture::clone(&capture());
        Arc::make_mut(&mut other.views[2].image).fill(9);
        let name = other.views[2].name.clone();
        let built = builder()
            .capture(Arc::new(other))
            .resume(checkpoint)
            .on_warning(move |warning| heard.borrow_mut().push(warning.clone()))
            .build();
        assert!(built.is_ok());
        assert_eq!(
            *said.borrow(),
            [Warning::PhotosChanged { views: vec![name] }]
        );
    }

    #[test]
    fn any_closure_is_a_loss_and_its_terms_are_logged_by_name() {
        let terms = LossTerms::new()
            .term("far", 0.5, |view, rendered| {
                Ok((rendered.image() - view.image()).abs().mean())
            })
            .term("opaque", 0.25, |_, rendered| Ok(rendered.alpha().mean()));
        let stop = Arc::new(AtomicBool::new(false));
        let raise = stop.clone();
        let trained = builder()
            .loss(terms)
            .interrupt(stop)
            .on_progress(move |state| raise.store(state.step >= 3, Ordering::Relaxed))
            .build()
            .unwrap()
            .run()
            .unwrap();
        assert_eq!(trained.history.terms, ["far", "opaque"]);
        let record = &trained.history.losses[2];
        let sum = 0.5 * record.terms[0] + 0.25 * record.terms[1];
        assert!((record.total - sum).abs() < 1e-6);
    }

    #[test]
    fn a_loss_that_sees_no_picture_or_no_number_is_an_error() {
        let constant = |view: &TargetView, _: &splat_model::ops::Rendered| Ok(view.image().mean());
        let error = builder().loss(constant).build().unwrap().run().unwrap_err();
        assert!(matches!(error, TrainError::Loss(_)), "{error}");

        let two = |_: &TargetView, rendered: &splat_model::ops::Rendered| {
            Ok(rendered.alpha().mean().repeat_dim(0, 2))
        };
        let error = builder().loss(two).build().unwrap().run().unwrap_err();
        assert!(error.to_string().contains("one for each name"), "{error}");

        let not_a_number = |_: &TargetView, rendered: &splat_model::ops::Rendered| {
            Ok(rendered.image().mean() * f64::NAN)
        };
        let error = builder()
            .loss(not_a_number)
            .build()
            .unwrap()
            .run()
            .unwrap_err();
        assert!(
            matches!(error, TrainError::NotFinite { in_a_row: 100, .. }),
            "{error}"
        );
    }

    #[test]
    fn a_step_that_fails_leaves_what_was_done_before_it() {
        let fails = |view: &TargetView, rendered: &splat_model::ops::Rendered| match view.step {
            7 => Err(OpError::Argument {
                op: "loss",
                what: "no more".into(),
            }),
            _ => Ok((rendered.image() - view.image()).abs().mean()),
        };
        let kept = Rc::new(RefCell::new(Vec::new()));
        let keep = kept.clone();
        let run = builder().loss(fails);
        let run = run.autosave(Duration::from_secs(3600), move |checkpoint| {
            keep.borrow_mut().push(checkpoint.step());
            Ok(())
        });
        let error = run.build().unwrap().run().unwrap_err();
        assert!(matches!(error, TrainError::Op(_)), "{error}");
        assert_eq!(*kept.borrow(), [7]);
    }

    /// A photo whose loss is NaN, whose gradients are too, is passed over; nothing of it stays in the scene or in
    /// the optimiser.
    #[test]
    fn a_photo_without_a_loss_is_named_and_passed_over() {
        let bad = capture().train_views().nth(3).unwrap().name.clone();
        let name = bad.clone();
        let loss = move |view: &TargetView, rendered: &splat_model::ops::Rendered| {
            let loss = (rendered.image() - view.image()).abs().mean();
            Ok(if view.name == name {
                loss * f64::NAN
            } else {
                loss
            })
        };
        let said = Rc::new(RefCell::new(Vec::new()));
        let heard = said.clone();
        let trained = builder()
            .loss(loss.clone())
            .on_warning(move |warning| heard.borrow_mut().push(warning.clone()))
            .build()
            .unwrap()
            .run()
            .unwrap();
        assert_eq!(trained.steps, 240);
        let [Warning::LossNotFinite { view, step }] = &said.borrow()[..] else {
            panic!("{:?}", said.borrow());
        };
        assert_eq!(*view, bad);
        assert!(*step <= 28, "first seen at step {step}");
        assert_eq!(trained.history.warnings, *said.borrow());
        // 240 steps are 8 rounds of 28 views and a part of one.
        let recorded = trained.history.losses.len();
        assert!((231..=232).contains(&recorded), "{recorded} losses");
        let data = trained.gaussians.to_data();
        let fields = [
            data.means.as_flattened(),
            data.log_scales.as_flattened(),
            data.quats.as_flattened(),
            &data.opacity_logits,
            data.sh0.as_flattened(),
            &data.sh_rest,
        ];
        assert!(
            fields
                .iter()
                .all(|field| field.iter().all(|x| x.is_finite()))
        );
        let mean = |losses: &[LossRecord]| losses.iter().map(|l| l.total).sum::<f32>();
        let (first, last) = (
            &trained.history.losses[..28],
            &trained.history.losses[recorded - 28..],
        );
        assert!(mean(last) < 0.7 * mean(first), "it did not learn");

        // What was said stays with the run, and is not said again.
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.safetensors");
        trained.checkpoint().unwrap().save(&path).unwrap();
        let checkpoint = Checkpoint::load(&path).unwrap();
        let resumed = builder()
            .loss(loss)
            .resume(checkpoint)
            .on_warning(|warning| panic!("{warning}"))
            .build()
            .unwrap()
            .run()
            .unwrap();
        assert_eq!(resumed.history, trained.history);
    }
}
