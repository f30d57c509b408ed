//! How a run is described before it begins.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use burn::tensor::Device;
use splat_data::{Capture, SceneScale, SplatData, View};
use splat_model::optimizer::{FieldOptimizer, SplatAdam};
use splat_model::strategy::{Adc, ImprovedGs, Mcmc, RunSchedule, Strategy};
use splat_model::{Field, Gaussians, Optimized, RowEdit, SparseOptimized, SplatModel};

use super::checkpoint::RunRecord;
use super::commands::{Command, Commands};
use super::fingerprint::Fingerprint;
use super::first::{default_max_gaussians, first_gaussians};
use super::loss_log::LossLog;
use super::spectrum::Spectrum;
use super::state::State;
use super::trainer::Trainer;
use super::watch::{Autosave, Watch};
use super::{
    Checkpoint, CheckpointError, History, IntoLoss, LossTerms, Progress, StrategyKind, TrainError,
    TrainSettings, Warning, resolution_schedule, sh_reduction, views,
};
use crate::calibration::{
    BundleAdjustment, CalibrationSchedule, RefineIntrinsics, RefinePoses, Watched,
    adjust_bundle_watched,
};
use crate::hooks::{Hook, Hooks};

type MakeModel<M> = dyn FnOnce(&SplatData, &Device) -> M + Send;
type MakeOptimizer = dyn Fn(&Field) -> Option<FieldOptimizer> + Send;

/// Builds a [`Trainer`].
pub struct TrainerBuilder<M: SplatModel = Gaussians> {
    capture: Arc<Capture>,
    config: TrainSettings,
    device: Device,
    model: Box<MakeModel<M>>,
    strategy: Option<Box<dyn Strategy<M>>>,
    /// Whether a strategy was given for another model.
    lost_strategy: bool,
    optimizer: Box<MakeOptimizer>,
    hooks: Hooks,
    loss: Option<LossTerms>,
    resume: Option<Checkpoint>,
    watch: Watch,
}

impl Trainer {
    /// Begins to describe a run on these photos.
    pub fn builder(capture: impl Into<Arc<Capture>>) -> TrainerBuilder {
        TrainerBuilder {
            capture: capture.into(),
            config: TrainSettings::default(),
            device: Device::default(),
            model: Box::new(Gaussians::from_data),
            strategy: None,
            lost_strategy: false,
            optimizer: Box::new(|_| None),
            hooks: Hooks::default(),
            loss: None,
            resume: None,
            watch: Watch::default(),
        }
    }
}

impl TrainerBuilder {
    /// Trains another model than [`Gaussians`], made of the first Gaussians on a device. To be
    /// called before [`strategy`](TrainerBuilder::strategy), whose type follows from it.
    pub fn model<M: SplatModel>(
        self,
        make: impl FnOnce(&SplatData, &Device) -> M + Send + 'static,
    ) -> TrainerBuilder<M> {
        TrainerBuilder {
            capture: self.capture,
            config: self.config,
            device: self.device,
            model: Box::new(make),
            strategy: None,
            lost_strategy: self.strategy.is_some(),
            optimizer: self.optimizer,
            hooks: self.hooks,
            loss: self.loss,
            resume: self.resume,
            watch: self.watch,
        }
    }
}

impl<M: SplatModel> TrainerBuilder<M> {
    /// Settings; the defaults are those of gsplat.
    pub fn settings(mut self, settings: TrainSettings) -> Self {
        self.config = settings;
        self
    }

    /// Where to compute. Default: Burn's default device.
    pub fn device(mut self, device: Device) -> Self {
        self.device = device;
        self
    }

    /// Which Gaussians there are, and what else changes from step to step. Default: that of the
    /// settings, with the settings for it.
    pub fn strategy(mut self, strategy: impl Strategy<M> + 'static) -> Self {
        self.strategy = Some(Box::new(strategy));
        self
    }

    /// The optimiser of each field for which this gives one; the others have [`SplatAdam`].
    /// Gradients are not clipped: `build()` of a Burn configuration leaves its clipping out, and a
    /// strategy can do it in `before_step`.
    pub fn optimizer(
        mut self,
        optimizer: impl Fn(&Field) -> Option<FieldOptimizer> + Send + 'static,
    ) -> Self {
        self.optimizer = Box::new(optimizer);
        self
    }

    /// Adds something that is trained beside the model.
    pub fn hook(mut self, hook: impl Hook) -> Self {
        self.hooks.0.push(Box::new(hook));
        self
    }

    /// The loss to minimise: a closure `|view, rendered| -> Result<Tensor<1>, OpError>` or
    /// [`LossTerms`]. Default: [`LossTerms::l1_ssim`].
    pub fn loss(mut self, loss: impl IntoLoss) -> Self {
        self.loss = Some(loss.into_loss());
        self
    }

    /// The run ends after the step during which this becomes true.
    pub fn interrupt(mut self, flag: Arc<AtomicBool>) -> Self {
        self.watch.interrupt = flag;
        self
    }

    /// The run does what it is told here between its steps, see
    /// [`command_queue`](super::command_queue).
    pub fn commands(mut self, commands: Receiver<Command>) -> Self {
        self.watch.commands = Commands::new(Some(commands));
        self
    }

    /// Goes on from a checkpoint instead of the capture's points. The capture must be that of the
    /// checkpoint, and so must the settings, see [`Checkpoint::check_settings`].
    pub fn resume(mut self, checkpoint: Checkpoint) -> Self {
        self.resume = Some(checkpoint);
        self
    }

    /// Measures held-out PSNR every so many steps, for the curves. Default: never.
    pub fn evaluate_every(mut self, steps: usize) -> Self {
        self.watch.evaluate_every = Some(steps.max(1));
        self
    }

    /// Calls `save` every so often, so that a crash loses no more than that much time. When it
    /// fails the run goes on with a warning, one for each kind of failure. Default: never.
    pub fn autosave(
        mut self,
        every: Duration,
        save: impl FnMut(&Checkpoint) -> Result<(), CheckpointError> + Send + 'static,
    ) -> Self {
        self.watch.autosave = Some(Autosave {
            every,
            last: Instant::now(),
            save: Box::new(save),
            failures: Vec::new(),
        });
        self
    }

    /// Called after every step.
    pub fn on_progress(mut self, callback: impl FnMut(Progress) + Send + 'static) -> Self {
        self.watch.on_progress = Box::new(callback);
        self
    }

    /// Called by [`build`](Self::build), from several threads, with the share of the adjustment of
    /// poses ([`CalibrationSettings::bundle_adjustment`]) that is done, from 0 to 1.
    ///
    /// [`CalibrationSettings::bundle_adjustment`]: crate::calibration::CalibrationSettings
    pub fn on_adjustment(mut self, callback: impl Fn(f64) + Send + Sync + 'static) -> Self {
        self.watch.on_adjustment = Box::new(callback);
        self
    }

    /// Called when something looks wrong; [`History::warnings`] keeps what is wrong with the run
    /// itself.
    pub fn on_warning(mut self, callback: impl FnMut(&Warning) + Send + 'static) -> Self {
        self.watch.on_warning = Box::new(callback);
        self
    }

    /// Checks everything and makes the first Gaussians.
    ///
    /// # Errors
    /// When there is nothing in the capture to train on, a setting is out of range, the model, the
    /// strategy or a hook cannot be used, or the checkpoint to resume from is another run's.
    pub fn build(mut self) -> Result<Trainer<M>, TrainError> {
        self.config.validate().map_err(TrainError::Config)?;
        if self.lost_strategy {
            let reason = "a strategy was given before the model; give it after `model`, whose type it works on";
            return Err(TrainError::Setup(reason.into()));
        }
        self.capture.check_trainable()?;
        let loss = self.loss.take();
        let loss = loss.unwrap_or_else(|| LossTerms::l1_ssim(self.config.ssim_weight));
        let schedule = schedule(&self.capture, &self.config)?;
        let device = self.device.without_autodiff().autodiff();
        let spectrum = match self.config.spectral_resolution {
            true => Some(Spectrum::of(&self.capture)?),
            false => None,
        };
        let adjusted = match self.resume {
            // Its poses are in the checkpoint.
            Some(_) => None,
            None => adjusted(&self.capture, &self.config, &mut self.watch)?,
        };
        let calibrating = calibration(
            &self.capture,
            &self.config,
            schedule.scene_scale,
            adjusted.as_ref(),
            &device,
        )?;
        // Before other hooks, which then see the cameras as they are rendered.
        self.hooks.0.splice(0..0, calibrating);
        check_hook_names(&self.hooks)?;
        let mut record = RunRecord {
            capture: Fingerprint::of(&self.capture)?,
            config: self.config.clone(),
            changes: Vec::new(),
        };
        let mut config = self.config;
        // What transparent photos were composited on is behind the scene.
        config.background = config.background.or(self.capture.background);
        let by_default = config.max_gaussians().is_none();
        if by_default {
            let share = config.max_gaussians_share;
            let mut most = default_max_gaussians(&self.capture, share);
            let selects = config.improved.selection.final_share.is_some();
            if selects && config.strategy == StrategyKind::Improved {
                // Small photos with many points: what is selected is a share of all of them.
                most = most.max(self.capture.points.len());
            }
            config.set_max_gaussians(most);
            (config.improved.validate()).map_err(|problem| {
                TrainError::Config(format!(
                    "{}; that is the default limit of growth for these photos: give `improved.max_gaussians` (--max-gaussians) or a larger `max_gaussians_share`",
                    problem.replacen('`', "`improved.", 1)
                ))
            })?;
        }
        let strategy = self.strategy.take();
        let strategy = strategy.unwrap_or_else(|| match config.strategy {
            StrategyKind::Adc => Box::new(Adc::new(config.density.clone())),
            StrategyKind::Mcmc => Box::new(Mcmc::new(config.mcmc.clone())),
            StrategyKind::Improved => Box::new(ImprovedGs::new(config.improved.clone())),
        });
        let mut terms: Vec<String> = loss.names().map(str::to_owned).collect();
        terms.extend(strategy.loss_term_names());

        let resumed = self.resume.take();
        if let Some(checkpoint) = &resumed {
            let hooks: Vec<&str> = self.hooks.0.iter().map(|hook| hook.name()).collect();
            let views = checkpoint.check_run(&record, &terms, &strategy.name(), &hooks)?;
            if !views.is_empty() {
                (self.watch.on_warning)(&Warning::PhotosChanged { views });
            }
            record.changes = checkpoint.changes_with(&record.config);
        }
        let origin = match &resumed {
            Some(checkpoint) => checkpoint.origin(),
            None => {
                let cameras: Vec<_> = self.capture.views.iter().map(View::camera).collect();
                schedule.scene_scale.origin(&cameras)
            }
        };
        let init = strategy.first_gaussians(&config.init);
        let with_init = TrainSettings {
            init: init.clone(),
            // The strategy has had its say.
            strategy: StrategyKind::Adc,
            ..record.config.clone()
        };
        let wrong = |reason: String| {
            // Names may go on with all settings.
            let name = strategy.name();
            let name = name.split(" with ").next().unwrap_or(&name);
            TrainError::Setup(format!("the strategy {name}: {reason}"))
        };
        with_init.validate().map_err(wrong)?;
        let points = match &adjusted {
            Some(adjusted) => adjusted.points.clone(),
            None => self.capture.points.iter().map(|p| p.position).collect(),
        };
        let splats = first_gaussians(&self.capture, &points, &init, schedule.scene_scale, origin)?;
        let model = (self.model)(&splats, &device);
        let mut model = optimized(model, &config, schedule.scene_scale, &self.optimizer)?;
        strategy.check(model.fields()).map_err(wrong)?;
        if resumed.is_none() && config.sparse_share > 0.0 {
            arrange(&mut model)?;
        }
        let model = SparseOptimized::new(model);
        let mut state = State {
            model,
            strategy,
            hooks: self.hooks,
            history: History {
                terms,
                ..History::default()
            },
            step: 0,
            elapsed: Duration::ZERO,
        };
        if let Some(checkpoint) = resumed {
            checkpoint.restore(&mut state, &device)?;
        }
        let photos = self.capture.split.train.len();
        let never = sh_reduction::never_due(&config, schedule, photos);
        if let (Some(warning), None) = (never, state.history.sh_reduction) {
            (self.watch.on_warning)(&warning);
        }
        if state.history.counts.is_empty() {
            let count = state.model.count();
            state.history.counts.push((0, count));
        }
        Ok(Trainer {
            views: views::ViewOrder::new(config.seed, self.capture.split.train.len()),
            capture: self.capture,
            config,
            device,
            loss,
            schedule,
            watch: self.watch,
            state,
            record,
            losses: LossLog::default(),
            in_step: false,
            spectrum,
            adjusted,
            coarse: resolution_schedule::CoarseViews::default(),
        })
    }
}

/// Poses and points adjusted to the keypoints of the capture, if poses are refined and the
/// keypoints fit.
fn adjusted(
    capture: &Capture,
    config: &TrainSettings,
    watch: &mut Watch,
) -> Result<Option<BundleAdjustment>, TrainError> {
    let settings = &config.calibration;
    if !(settings.poses && settings.bundle_adjustment) {
        return Ok(None);
    }
    let watched = Watched::whole(&watch.interrupt, &watch.on_adjustment);
    let adjusted = adjust_bundle_watched(watched, capture)?;
    if watch.interrupt.load(Ordering::Relaxed) {
        return Err(TrainError::Interrupted);
    }
    let Some(adjusted) = adjusted else {
        (watch.on_warning)(&Warning::TooFewKeypoints);
        return Ok(None);
    };
    if !adjusted.fits {
        (watch.on_warning)(&Warning::KeypointsDoNotFit {
            before: adjusted.error_before,
            after: adjusted.error_after,
            rematched: adjusted.error_rematched,
        });
        return Ok(None);
    }
    Ok(Some(adjusted))
}

/// The hooks that refine the cameras, as far as the settings want it.
fn calibration(
    capture: &Capture,
    config: &TrainSettings,
    scene: SceneScale,
    adjusted: Option<&BundleAdjustment>,
    device: &Device,
) -> Result<Vec<Box<dyn Hook>>, TrainError> {
    let settings = &config.calibration;
    let schedule = config.calibration_schedule(capture);
    let mut hooks: Vec<Box<dyn Hook>> = Vec::new();
    if settings.intrinsics {
        // A wrong lens is wrong in all views alike. The first Gaussians, whose colours are those of
        // the points, show it best; later ones have made up for it.
        let schedule = CalibrationSchedule {
            start: 0,
            ..schedule
        };
        let hook = RefineIntrinsics::new(&capture.views, settings.clone(), schedule, device)?;
        hooks.push(Box::new(hook));
    }
    if settings.poses {
        let views = capture.split.train.len();
        let mut hook = RefinePoses::new(views, scene, settings, schedule, device)?;
        if let Some(adjusted) = adjusted {
            let cameras: Vec<_> = capture.train_views().map(View::camera).collect();
            hook = hook.adjusted(&cameras, adjusted, settings)?;
        }
        hooks.push(Box::new(hook));
    }
    Ok(hooks)
}

/// Length, scene size and seed of the run.
fn schedule(capture: &Capture, config: &TrainSettings) -> Result<RunSchedule, TrainError> {
    let scene_scale = capture.scene_scale();
    if !scene_scale.is_in_range() {
        return Err(TrainError::SceneSize {
            capture: capture.root.clone(),
            size: scene_scale.length(),
        });
    }
    Ok(RunSchedule {
        steps: config.steps,
        scene_scale,
        seed: config.seed,
    })
}

/// The model with an optimiser for each of its fields.
fn optimized<M: SplatModel>(
    model: M,
    config: &TrainSettings,
    scene: SceneScale,
    optimizer: &MakeOptimizer,
) -> Result<Optimized<M>, TrainError> {
    let usual = |field: &Field| SplatAdam::of_field(field, config.adam_rows(), scene).into();
    let optimizer = |field: &Field| optimizer(field).unwrap_or_else(|| usual(field));
    let rates = config.learning_rates.for_steps(config.steps);
    let model = Optimized::of_model(model, &rates, optimizer);
    let model = model.map_err(|error| TrainError::Setup(error.to_string()))?;
    if config.sh_reduction.is_some() {
        sh_reduction::check(model.model())?;
    }
    Ok(model)
}

/// Fewer Gaussians stay in the order of their points until the first refinement.
const ARRANGE_FROM: usize = 50_000;

/// Makes neighbours in space neighbours in memory, so that a view sees few groups of rows.
/// Strategies keep it so when they edit rows.
fn arrange<M: SplatModel>(model: &mut Optimized<M>) -> Result<(), TrainError> {
    let whole = model.model();
    if whole.count() < ARRANGE_FROM || !whole.is_row_wise() {
        return Ok(());
    }
    let [means] = model.read_f64(["means"])?;
    let means = means.as_chunks().0;
    let mut edit = RowEdit::identity(means.len());
    edit.arrange(means);
    Ok(model.edit_rows(&edit)?)
}

/// Names under which checkpoints keep hooks.
fn check_hook_names(hooks: &Hooks) -> Result<(), TrainError> {
    for (index, hook) in hooks.0.iter().enumerate() {
        let name = hook.name();
        let twice = hooks.0[..index].iter().any(|other| other.name() == name);
        if twice || name.is_empty() || name.contains('.') {
            return Err(TrainError::Setup(format!(
                "hook {index} (counted from 0) is named `{name}`; a name must be its own, not empty, and without a dot"
            )));
        }
    }
    Ok(())
}
