//! One training step: render, measure the loss, step the optimisers, let the strategy look at it
//! all.

use std::borrow::Cow;
use std::sync::Arc;
use std::time::Instant;

use burn::tensor::{Device, Gradients, Tensor};
use splat_data::{Capture, View};
use splat_model::strategy::{
    Pass, RowsNeeded, RunSchedule, ScreenView, ScreenWants, SparseStep, StepContext, StepInfo,
    Strategy,
};
use splat_model::{
    Camera, CameraTensors, Field, FieldGradients, FieldStep, Gaussians, Part, RenderSettings,
    SceneScale, SplatModel, project_gaussians, render_projected_on,
};
use splat_ops::device::keep_awake;
use splat_ops::{OpError, Projected, SH_DEGREE_MAX};
use tracing::trace_span;

use super::checkpoint::RunRecord;
use super::loss_log::{LossLog, ReadLoss, UnreadLoss, check_finite};
use super::spectrum::Spectrum;
use super::state::State;
use super::training_views::CaptureViews;
use super::watch::Watch;
use super::{
    Checkpoint, LossTerms, TargetView, TrainError, TrainSettings, Warning, resolution_schedule,
    room, sh_schedule, views, warnings,
};
use crate::calibration::BundleAdjustment;
use crate::hooks::{HookView, Purpose};
use crate::photo::{mask_of, pixels_u8};

/// A training run.
///
/// ```
/// use burn::tensor::Device;
/// use splat_data::{Capture, CaptureSettings};
/// use splat_trainer::{TrainSettings, Trainer, evaluate};
///
/// # let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
/// let capture = Capture::load(folder, &CaptureSettings::new().with_downscale(16))?;
/// let trained = Trainer::builder(capture.clone())
///     .settings(TrainSettings::new().with_steps(3))
///     .device(Device::flex())
///     .build()?
///     .run()?;
/// let views: Vec<_> = capture.test_views().collect();
/// let settings = &trained.render_settings;
/// let scores = evaluate(&trained.model, &views, settings, &Device::flex(), |_, _| {})?;
/// assert!(scores.psnr > 5.0 && trained.steps == 3);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Trainer<M: SplatModel = Gaussians> {
    pub(super) capture: Arc<Capture>,
    pub(super) config: TrainSettings,
    pub(super) device: Device,
    pub(super) loss: LossTerms,
    pub(super) schedule: RunSchedule,
    pub(super) views: views::ViewOrder,
    pub(super) watch: Watch,
    pub(super) state: State<M>,
    pub(super) record: RunRecord,
    pub(super) losses: LossLog,
    /// Whether a step is half done.
    pub(super) in_step: bool,
    pub(super) coarse: resolution_schedule::CoarseViews,
    /// Of the photos, if their sizes follow from it.
    pub(super) spectrum: Option<Spectrum>,
    pub(super) adjusted: Option<BundleAdjustment>,
}

/// A view of a step after its loss was measured.
struct Measured {
    /// Index of the view among those that are trained on.
    training_index: usize,
    loss: Tensor<1>,
    terms: Vec<Tensor<1>>,
    projected: Projected,
    /// Leaves for the gradients of the splats, and for their absolute gradients.
    probes: [Option<Tensor<3>>; 2],
}

impl<M: SplatModel> Trainer<M> {
    /// Takes the next step of the run, for whoever drives the loop instead of [`run`](Self::run),
    /// which also watches, measures and keeps what becomes of it.
    ///
    /// # Errors
    /// As those of [`run`](Self::run), and after the last step of the run.
    pub fn step(&mut self) -> Result<(), TrainError> {
        if self.state.step >= self.config.steps {
            let steps = self.config.steps;
            return Err(TrainError::Config(format!(
                "all {steps} steps of the run are done"
            )));
        }
        let _span = trace_span!("step").entered();
        let start = Instant::now();
        keep_awake(&self.device);
        self.update()?;
        let inspects = warnings::loss_checks::is_due(self.state.step, self.config.steps);
        if self.losses.is_full() || inspects {
            self.read_losses()?;
        }
        self.state.elapsed += start.elapsed();
        Ok(())
    }

    /// The state to resume from, with all losses so far.
    ///
    /// # Errors
    /// When the device fails, or a step ended in the middle by an error.
    pub fn checkpoint(&mut self) -> Result<Checkpoint, TrainError> {
        if self.in_step {
            return Err(TrainError::Setup(
                "a step failed half way, which is no state to go on from".into(),
            ));
        }
        self.read_losses()?;
        Ok(Checkpoint::of(&self.state, &self.record)?)
    }

    /// How poses and points were adjusted to the keypoints of the capture, if they were.
    pub fn bundle_adjustment(&self) -> Option<&BundleAdjustment> {
        self.adjusted.as_ref()
    }

    /// Says that the limit of growth of the settings, or what their selection keeps, is below the
    /// Gaussians that there are, if it is. A strategy of the caller's own has limits of its own.
    pub fn warning_of_room(&self) -> Option<Warning> {
        let by_default = self.record.config.max_gaussians().is_none();
        let points = self.capture.points.len();
        room::warning(&self.config, points, self.state.model.count(), by_default)
    }

    /// Size of the scene, from which every length of the run follows.
    pub fn scene_scale(&self) -> SceneScale {
        self.schedule.scene_scale
    }

    /// The model as it is after the last step; a copy where rows of it are behind, see
    /// [`SparseOptimized`](splat_model::SparseOptimized).
    pub fn model(&self) -> Cow<'_, M> {
        self.state.model.model()
    }

    fn update(&mut self) -> Result<(), TrainError> {
        let at = StepInfo {
            step: self.state.step,
            run: self.schedule,
        };
        let wants = self.state.strategy.screen_wants(&at);
        let count = self.config.views_per_step;
        let looks = (0..count)
            .map(|i| self.look(at.step * count + i, &at))
            .collect::<Result<Vec<_>, _>>()?;
        let part = self.part(&at, &looks)?;
        let model = match &part {
            Some(part) => Cow::Borrowed(part.model()),
            None => {
                self.state.model.whole();
                self.state.model.model()
            }
        };
        let measured = looks
            .into_iter()
            .map(|look| self.measure(look, &model, &at, wants))
            .collect::<Result<Vec<_>, _>>()?;
        drop(model);
        let (loss, unread, screen) = self.together(measured, &at)?;
        let mut gradients = trace_span!("backward").in_scope(|| loss.backward());
        let screen: Vec<ScreenView> = screen
            .into_iter()
            .map(|(view, projected, probes)| {
                let [gradient, absgrad] = probes.map(|probe| {
                    let gradient = probe?.grad_remove(&mut gradients)?;
                    // Scaled back to the view's own loss: the step's loss is the mean.
                    Some(match count {
                        1 => gradient,
                        _ => gradient * count as f64,
                    })
                });
                ScreenView {
                    view,
                    projected,
                    gradient,
                    absgrad,
                }
            })
            .collect();
        let needed = match part {
            Some(_) => self.state.strategy.rows_needed(&at),
            None => RowsNeeded::All,
        };
        let backward = Backward { gradients, screen };
        match part {
            Some(part) => self.step_part(part, backward, &at)?,
            None => self.step_all(backward, &at)?,
        }
        self.losses.push(unread);
        self.state.step += 1;
        // Gaussians added after the last step would never be trained.
        if self.state.step < self.config.steps && needed != RowsNeeded::Seen {
            let done = StepInfo {
                step: self.state.step,
                ..at
            };
            self.strategy(&done, &mut FieldGradients::new(), &[], Moment::After)?;
        }
        self.reduce_sh_degrees()?;
        self.in_step = false;
        Ok(())
    }

    /// Steps all rows.
    fn step_all(&mut self, backward: Backward, at: &StepInfo) -> Result<(), TrainError> {
        let Backward {
            mut gradients,
            screen,
        } = backward;
        let whole = self.state.model.whole();
        let mut fields = whole.gradients(&mut gradients);
        let edits = whole.edits();
        // From here on an error leaves a step half done, which is no state to go on from.
        self.in_step = true;
        self.strategy(at, &mut fields, &screen, Moment::Before)?;
        if self.state.model.whole().edits() != edits {
            return Err(TrainError::Setup(format!(
                "the strategy {} edited rows in `before_step`, where gradients belong to the old ones; edit in `after_step`",
                self.state.strategy.name()
            )));
        }
        self.state.hooks.step(&mut gradients, at)?;
        // The optimisers need nothing of the picture.
        drop((screen, gradients));
        let _optimizer = trace_span!("optimizer").entered();
        let strategy = &self.state.strategy;
        let how = |field: &Field| how(strategy.as_ref(), field, at);
        Ok(self.state.model.step(fields, how)?)
    }

    /// Steps the rows of a part.
    fn step_part(
        &mut self,
        part: Part<M>,
        backward: Backward,
        at: &StepInfo,
    ) -> Result<(), TrainError> {
        let Backward {
            mut gradients,
            screen,
        } = backward;
        let mut fields = part.gradients(&self.state.model, &mut gradients);
        // As above.
        self.in_step = true;
        self.state.strategy.sparse_step(&mut SparseStep {
            at: *at,
            rows: part.rows(),
            gradients: &mut fields,
            screen: &screen,
        })?;
        self.state.hooks.step(&mut gradients, at)?;
        drop((screen, gradients));
        let _optimizer = trace_span!("optimizer").entered();
        let strategy = &self.state.strategy;
        let how = |field: &Field| how(strategy.as_ref(), field, at);
        Ok(self.state.model.step_part(part, fields, how)?)
    }

    /// The rows that the views of a step may see, if the step can be one of these alone and is
    /// worth it.
    fn part(&mut self, at: &StepInfo, looks: &[Look]) -> Result<Option<Part<M>>, TrainError> {
        let (share, strategy) = (self.config.sparse_share, &self.state.strategy);
        let steps = |field: &Field| matches!(strategy.field_step(at, field), FieldStep::Step(_));
        if !(share > 0.0)
            || strategy.rows_needed(at) == RowsNeeded::All
            || !strategy.loss_term_names().is_empty()
            || !self.state.model.fields().iter().all(steps)
        {
            return Ok(None);
        }
        let _span = trace_span!("seen rows").entered();
        let mut cameras = Vec::with_capacity(looks.len());
        for look in looks {
            // Hooks may have moved it.
            match self.state.hooks.0.is_empty() {
                true => cameras.push(look.camera),
                false => cameras.extend(look.cameras.to_cameras()?),
            }
        }
        let settings = self.render_settings(at).project;
        let model = &mut self.state.model;
        let rows = model.seen(&cameras, &settings);
        let most = share * model.count() as f64;
        let rows = rows.filter(|rows| !rows.is_empty() && rows.len() as f64 <= most);
        Ok(rows.map(|rows| model.part(rows)))
    }

    /// The training view whose turn is this one, counted over the whole run, and its camera.
    fn look(&mut self, turn: usize, at: &StepInfo) -> Result<Look, TrainError> {
        let training_index = self.views.at(turn);
        let index = self.capture.split.train[training_index];
        let factor = self.state.strategy.photo_factor(at);
        let spectrum = self.spectrum.as_ref();
        let factor =
            factor.unwrap_or_else(|| resolution_schedule::factor(&self.config, spectrum, at));
        let view = self.coarse.view(&self.capture, index, factor.max(1));
        let camera = view.camera().relative_to(self.state.model.origin());
        let cameras = CameraTensors::from_camera(&camera, &self.device);
        let hook_view = hook_view(training_index, &view);
        let cameras = self.state.hooks.cameras(&hook_view, cameras)?;
        Ok(Look {
            training_index,
            view,
            camera,
            cameras,
        })
    }

    /// Renders a training view and measures its loss.
    fn measure(
        &self,
        look: Look,
        model: &M,
        at: &StepInfo,
        wants: ScreenWants,
    ) -> Result<Measured, TrainError> {
        let Look {
            training_index,
            view,
            cameras,
            ..
        } = look;
        let view = view.loaded()?;
        let hooks = &self.state.hooks;
        let hook_view = hook_view(training_index, &view);
        let settings = self.render_settings(at);

        let render = trace_span!("render").entered();
        let mut projected = project_gaussians(model, &cameras, &settings)?;
        let mut probes = [None, None];
        if wants.gradients {
            let (probed, leaf) = projected.with_screen_probe();
            (projected, probes[0]) = (probed, Some(leaf));
        }
        if wants.absgrad {
            let (probed, leaf) = projected.with_absgrad();
            (projected, probes[1]) = (probed, Some(leaf));
        }
        let background = hooks.background(&hook_view, &cameras)?;
        let rendered = render_projected_on(model, &projected, &cameras, background, &settings)?;
        let rendered = hooks.image(&hook_view, rendered)?;
        drop(render);
        let pixels = trace_span!("photo").in_scope(|| pixels_u8(&view, &self.device));
        let target = TargetView::new(&view.name, pixels, &cameras, at.step)
            .with_mask(mask_of(&view, &self.device));
        let evaluated = trace_span!("loss").in_scope(|| self.loss.evaluate(&target, &rendered))?;
        let Some((mut loss, mut terms)) = evaluated else {
            return Err(TrainError::Loss("has no term"));
        };
        let names = self.state.strategy.loss_term_names();
        if !names.is_empty() {
            let pass = Pass {
                at: *at,
                view: training_index,
                model,
                projected: &projected,
                rendered: &rendered,
            };
            let added = self.state.strategy.loss_terms(&pass)?;
            if added.len() != names.len() || added.iter().any(|term| term.dims() != [1]) {
                let shapes: Vec<_> = added.iter().map(Tensor::dims).collect();
                return Err(TrainError::Setup(format!(
                    "the strategy {} names the loss terms {names:?} and gives tensors of shapes {shapes:?}; give one of [1] for each name",
                    self.state.strategy.name()
                )));
            }
            for term in added {
                terms.push(term.clone().inner());
                loss = loss + term;
            }
        }
        if !loss.is_tracked() {
            return Err(TrainError::Loss("does not depend on the rendered image"));
        }
        Ok(Measured {
            training_index,
            loss,
            terms,
            projected,
            probes,
        })
    }

    /// The mean loss of the views of a step, its values to be logged, and what is on the screens.
    fn together(&self, measured: Vec<Measured>, at: &StepInfo) -> Result<Together, TrainError> {
        let count = measured.len();
        let share = 1.0 / count as f64;
        let mut screen = Vec::with_capacity(count);
        let mut views = Vec::with_capacity(count);
        let mut sums: Option<(Tensor<1>, Vec<Tensor<1>>)> = None;
        for one in measured {
            views.push(self.capture.split.train[one.training_index]);
            screen.push((one.training_index, one.projected, one.probes));
            sums = Some(match sums {
                None => (one.loss, one.terms),
                Some((loss, terms)) => {
                    let terms = terms.into_iter().zip(one.terms).map(|(a, b)| a + b);
                    (loss + one.loss, terms.collect())
                }
            });
        }
        let Some((mut loss, mut terms)) = sums else {
            let reason = "`views_per_step` must be at least 1";
            return Err(TrainError::Config(reason.into()));
        };
        if count > 1 {
            loss = loss * share;
            terms = terms.into_iter().map(|term| term * share).collect();
        }
        let mut values = vec![loss.clone().inner()];
        values.extend(terms);
        let unread = UnreadLoss {
            step: at.step + 1,
            views,
            values,
        };
        Ok((loss, unread, screen))
    }

    /// Lets the strategy look, before or after the optimisers' step.
    fn strategy(
        &mut self,
        at: &StepInfo,
        gradients: &mut FieldGradients,
        screen: &[ScreenView],
        moment: Moment,
    ) -> Result<(), OpError> {
        let origin = self.state.model.origin();
        let device = self.device.clone();
        let views = CaptureViews {
            capture: &self.capture,
            origin,
            device: &device,
        };
        let mut context = StepContext {
            at: *at,
            model: self.state.model.whole(),
            gradients,
            screen,
            settings: self
                .config
                .render_settings(SH_DEGREE_MAX, self.schedule.scene_scale),
            views: &views,
        };
        match moment {
            Moment::Before => self.state.strategy.before_step(&mut context),
            Moment::After => {
                let _density = trace_span!("density").entered();
                let refined = self.state.strategy.after_step(&mut context)?.is_some();
                let count = self.state.model.count();
                let before = self.state.history.counts.last().map(|(_, count)| *count);
                if refined || before != Some(count) {
                    self.state.history.counts.push((at.step, count));
                }
                Ok(())
            }
        }
    }

    pub(super) fn render_settings(&self, at: &StepInfo) -> RenderSettings {
        let degree = sh_schedule::degree(&self.config, at, self.capture.split.train.len());
        self.config
            .render_settings(degree, self.schedule.scene_scale)
    }

    /// Reads all pending losses in one transfer.
    pub(super) fn read_losses(&mut self) -> Result<(), TrainError> {
        for read in self.losses.read(self.state.history.terms.len())? {
            match read {
                ReadLoss::Finite(record) => self.state.history.losses.push(record),
                ReadLoss::NotFinite(step, views, value) => {
                    let names = views
                        .iter()
                        .map(|view| self.capture.views[*view].name.as_str());
                    let view = names.collect::<Vec<_>>().join(", ");
                    let last = self.state.history.losses.last();
                    check_finite(step, &view, value, last, self.config.steps)?;
                    self.warn(Warning::LossNotFinite { view, step });
                }
            }
        }
        Ok(())
    }
}

/// A training view of a step and its camera.
struct Look {
    /// Index of the view among those that are trained on.
    training_index: usize,
    view: View,
    /// Relative to the model's origin.
    camera: Camera,
    /// The camera as hooks have it.
    cameras: CameraTensors,
}

/// What a backward pass gives.
struct Backward {
    gradients: Gradients,
    screen: Vec<ScreenView>,
}

pub(super) fn hook_view(training_index: usize, view: &View) -> HookView<'_> {
    HookView {
        training_index: Some(training_index),
        name: &view.name,
        purpose: Purpose::Training,
    }
}

/// The rate of a field at a step, and what the strategy makes of it.
fn how<M: SplatModel>(
    strategy: &dyn Strategy<M>,
    field: &Field,
    at: &StepInfo,
) -> (f64, FieldStep) {
    let rate = field.rate_at(at.step, at.run.steps, at.run.scene_scale);
    (rate, strategy.field_step(at, field))
}

/// The loss of a step, its values to be logged, and of each view its index, its splats and the
/// probe of their gradients.
type Together = (
    Tensor<1>,
    UnreadLoss,
    Vec<(usize, Projected, [Option<Tensor<3>>; 2])>,
);

/// When the strategy looks.
enum Moment {
    Before,
    After,
}
