//! Runs with external parts: a strategy, a model, a hook, an optimiser, commands.

use burn::module::{Module, Param};
use burn::optim::AdamConfig;
use burn::tensor::{Gradients, Tensor};
use splat_data::SplatData;
use splat_model::ops::{Projected, Rendered};
use splat_model::optimizer::{SplatAdam, StateRecord, ThroughHost};
use splat_model::strategy::{
    Pass, Refinement, ScreenWants, StepContext, StepInfo, Strategy, weighted_contributions,
};
use splat_model::{
    CameraTensors, Field, FieldStep, Gaussians, InitSettings, LearningRates, Moments, Optimized,
    RenderSettings, RowEdit, SplatModel,
};

use super::*;
use crate::hooks::{Hook, HookView, Purpose};

/// Gaussians with an additional parameter that dims their colours.
#[derive(Module, Debug)]
struct Dimmed {
    gaussians: Gaussians,
    dim: Param<Tensor<1>>,
}

impl Dimmed {
    fn new(data: &SplatData, device: &Device) -> Self {
        Self {
            gaussians: Gaussians::from_data(data, device),
            dim: Param::from_tensor(Tensor::zeros([data.len()], device)),
        }
    }
}

impl SplatModel for Dimmed {
    fn origin(&self) -> [f64; 3] {
        self.gaussians.origin
    }

    fn means(&self) -> Tensor<2> {
        self.gaussians.means.val()
    }

    fn quats(&self) -> Tensor<2> {
        self.gaussians.quats.val()
    }

    fn scales(&self) -> Tensor<2> {
        self.gaussians.scales()
    }

    fn opacities(&self) -> Tensor<1> {
        self.gaussians.opacities()
    }

    fn shade(
        &self,
        cameras: &CameraTensors,
        projected: &Projected,
        settings: &RenderSettings,
    ) -> Result<Tensor<3>, OpError> {
        let colors = self.gaussians.shade(cameras, projected, settings)?;
        let dim = self.dim.val().exp().reshape([1, -1, 1]);
        let [c, _, d] = colors.dims();
        Ok(colors * dim.repeat_dim(0, c).repeat_dim(2, d))
    }

    fn fields(&self, rates: &LearningRates) -> Vec<Field> {
        let fields = self.gaussians.fields(rates).into_iter();
        let mut fields: Vec<Field> = fields.map(|field| field.nested("gaussians")).collect();
        fields.push(Field::rows("dim", 0.01));
        fields
    }

    fn to_data(&self) -> SplatData {
        self.gaussians.to_data()
    }
}

/// Uses the whole interface of a strategy.
#[derive(Default)]
struct Everything {
    seen: usize,
}

impl<M: SplatModel> Strategy<M> for Everything {
    fn name(&self) -> String {
        "everything".into()
    }

    fn first_gaussians(&self, settings: &InitSettings) -> InitSettings {
        InitSettings {
            opacity: 0.5,
            ..settings.clone()
        }
    }

    fn photo_factor(&self, at: &StepInfo) -> Option<u32> {
        Some(if at.step < 2 { 2 } else { 1 })
    }

    fn screen_wants(&self, _: &StepInfo) -> ScreenWants {
        ScreenWants::gradients()
    }

    fn loss_term_names(&self) -> Vec<String> {
        vec!["opacity".into()]
    }

    fn loss_terms(&self, pass: &Pass<M>) -> Result<Vec<Tensor<1>>, OpError> {
        Ok(vec![pass.model.opacities().mean() * 0.01])
    }

    fn field_step(&self, at: &StepInfo, field: &Field) -> FieldStep {
        match field.name.as_str() {
            "sh0" if at.step.is_multiple_of(2) => FieldStep::Accumulate,
            "quats" => FieldStep::Skip,
            _ => FieldStep::Step(0.5),
        }
    }

    fn before_step(&mut self, context: &mut StepContext<M>) -> Result<(), OpError> {
        let [view] = context.screen else {
            panic!("one view a step")
        };
        let gradient = view.gradient.clone().expect("it was wanted");
        assert_eq!(gradient.dims()[1], context.model.model().count());
        assert!(context.gradients.contains_key("means"));
        self.seen += 1;
        Ok(())
    }

    fn after_step(&mut self, context: &mut StepContext<M>) -> Result<Option<Refinement>, OpError> {
        if context.at.step != 4 {
            return Ok(None);
        }
        let (camera, photo) = (context.views.camera(0), context.views.photo(0)?);
        let error = photo.slice([
            0..1,
            0..camera.size.height as usize,
            0..camera.size.width as usize,
            0..1,
        ]);
        let scores =
            weighted_contributions(context.model.model(), &camera, &context.settings, error)?;
        let scores: Vec<f32> = scores.into_data().try_into_vec().unwrap();
        let n = scores.len();
        assert_eq!(n, context.model.model().count());
        assert!(
            scores.iter().all(|score| *score >= 0.0) && scores.iter().any(|score| *score > 0.0)
        );
        let mut edit = RowEdit::identity(n);
        let new = edit.push(0, Moments::Restart);
        edit.offset(new, "means", &[0.1, 0.0, 0.0]);
        edit.relocate(1, 0, Moments::Restart);
        edit.set(1, "opacity_logits", &[-1.0]);
        context.model.edit_rows(&edit)?;
        Ok(Some(Refinement {
            cloned: 1,
            relocated: 1,
            ..Refinement::default()
        }))
    }

    fn save(&self) -> Result<StateRecord, OpError> {
        let mut record = StateRecord::default();
        record.scalars.insert("seen".into(), self.seen.into());
        Ok(record)
    }

    fn restore(&mut self, record: StateRecord, _: usize, _: &Device) -> Result<(), String> {
        let seen = record.scalars.get("seen").ok_or("`seen` is missing")?;
        self.seen = usize::try_from(*seen).map_err(|error| error.to_string())?;
        Ok(())
    }
}

/// A gain for each training view.
#[derive(Module, Debug)]
struct Gains {
    log_gains: Param<Tensor<1>>,
}

struct Exposure(Optimized<Gains>);

impl Exposure {
    fn new(views: usize, device: &Device) -> Self {
        let log_gains = Param::from_tensor(Tensor::zeros([views], &device.clone().autodiff()));
        let gains = Optimized::of_module(Gains { log_gains }, 0.01, |_| SplatAdam::new().into());
        Self(gains.unwrap())
    }

    fn gains(&self) -> Vec<f32> {
        self.0
            .model()
            .log_gains
            .val()
            .into_data()
            .try_into_vec()
            .unwrap()
    }
}

impl Hook for Exposure {
    fn name(&self) -> &str {
        "exposure"
    }

    fn image(&self, view: &HookView, rendered: Rendered) -> Result<Rendered, OpError> {
        let Some(index) = view.training_index else {
            assert_eq!(view.purpose, Purpose::HeldOut);
            return Ok(rendered);
        };
        let gain = self.0.model().log_gains.val().narrow(0, index, 1).exp();
        rendered.with_image(rendered.image() * gain.reshape([1, 1, 1, 1]))
    }

    fn step(&mut self, gradients: &mut Gradients, _: &StepInfo) -> Result<(), OpError> {
        let gradients = self.0.gradients(gradients);
        assert_eq!(gradients.len(), 1);
        self.0
            .step(gradients, |field| (field.rate, FieldStep::Step(1.0)))
    }

    fn save(&self) -> Result<StateRecord, OpError> {
        self.0.save()
    }

    fn restore(&mut self, record: StateRecord, device: &Device) -> Result<(), String> {
        self.0.restore(record, device)
    }
}

fn extended(steps: usize) -> TrainerBuilder<Dimmed> {
    let capture = capture();
    let views = capture.split.train.len();
    Trainer::builder(capture)
        .settings(TrainSettings {
            steps,
            ..TrainSettings::default()
        })
        .device(Device::flex())
        .evaluate_every(4)
        .hook(Exposure::new(views, &Device::flex()))
        .model(Dimmed::new)
        .strategy(Everything::default())
        .optimizer(|field| {
            (field.name == "dim").then(|| ThroughHost(AdamConfig::new().build()).into())
        })
}

/// A run of external parts trains, and resumes from a checkpoint with the same numbers.
#[test]
fn parts_from_outside_train_and_resume() {
    let whole = extended(9).build().unwrap().run().unwrap();
    assert_eq!(whole.history.terms, ["l1", "d_ssim", "opacity"]);
    let opacity = f64::from(whole.history.losses[0].terms[2]);
    assert!((opacity - 0.005).abs() < 1e-5, "{opacity}");
    let points = capture().points.len();
    assert_eq!(whole.history.counts, [(0, points), (4, points + 1)]);
    assert_eq!(whole.history.held_out_psnr.len(), 3);
    let dim: Vec<f32> = whole.model.dim.val().into_data().try_into_vec().unwrap();
    assert!(dim.len() == points + 1 && dim.iter().any(|dim| *dim != 0.0));
    let gains = whole.hook::<Exposure>().unwrap().gains();
    assert!(gains.iter().any(|gain| *gain != 0.0));
    // The quaternions were not stepped.
    assert_eq!(whole.model.to_data().quats[5], [1.0, 0.0, 0.0, 0.0]);

    let stop = Arc::new(AtomicBool::new(false));
    let raise = stop.clone();
    let first = extended(9)
        .interrupt(stop)
        .on_progress(move |state| raise.store(state.step == 5, Ordering::Relaxed));
    let checkpoint = first.build().unwrap().run().unwrap().checkpoint().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint.safetensors");
    checkpoint.save(&path).unwrap();
    let resumed = extended(9).resume(Checkpoint::load(&path).unwrap());
    let resumed = resumed.build().unwrap().run().unwrap();
    assert_eq!(resumed.history.losses, whole.history.losses);
    assert!(resumed.model.to_data() == whole.model.to_data());
    assert_eq!(resumed.hook::<Exposure>().unwrap().gains(), gains);

    let message =
        |built: Result<Trainer<Dimmed>, TrainError>| built.map(drop).unwrap_err().to_string();
    let other = extended(9).strategy(splat_model::strategy::Adc::new(Default::default()));
    let other = message(other.resume(Checkpoint::load(&path).unwrap()).build());
    assert!(
        other.contains("a loss of the terms") || other.contains("the strategy everything"),
        "{other}"
    );
    let twice = message(extended(9).hook(Exposure::new(3, &Device::flex())).build());
    assert!(twice.contains("named `exposure`"), "{twice}");
}

/// The mean over several views equals the mean of individual views.
#[test]
fn a_step_of_several_views_is_along_their_mean() {
    let run = |views: usize, steps: usize| {
        let config = TrainSettings {
            steps,
            views_per_step: views,
            ..TrainSettings::default()
        };
        builder().settings(config).build().unwrap().run().unwrap()
    };
    let (single, double) = (run(1, 1), run(2, 2));
    let first = f64::from(double.history.losses[0].total);
    let one = f64::from(single.history.losses[0].total);
    // The first of the two views is that of the single-view run; the loss is the mean of both.
    assert!(
        (first - one).abs() > 1e-6 && (first / one - 1.0).abs() < 0.5,
        "{first} {one}"
    );
    assert_eq!(double.history.losses.len(), 2);
    assert!(double.history.losses[1].total < double.history.losses[0].total * 1.2);
}

/// By command, a run waits, takes single steps, sends its scene, saves its state and ends.
#[test]
fn a_run_does_what_it_is_told() {
    fn is_send<T: Send>(value: T) -> T {
        value
    }
    let (commands, queue) = command_queue();
    let kept = Arc::new(Mutex::new(Vec::new()));
    let keep = kept.clone();
    let trainer = builder()
        .commands(queue)
        .autosave(Duration::from_secs(3600), move |checkpoint| {
            keep.lock().unwrap().push(checkpoint.step());
            Ok(())
        })
        .build()
        .unwrap();
    let mut trainer = Some(is_send(trainer));
    commands.send(Command::Pause).unwrap();
    commands.send(Command::Step).unwrap();
    commands.send(Command::Step).unwrap();
    let (to, snapshots) = std::sync::mpsc::channel();
    commands.send(Command::Snapshot(to)).unwrap();
    commands.send(Command::Save).unwrap();
    let run = std::thread::spawn({
        let trainer = trainer.take().unwrap();
        move || trainer.run()
    });
    let snapshot = snapshots.recv().unwrap();
    assert_eq!(
        (snapshot.step, snapshot.scene.len()),
        (2, capture().points.len())
    );
    assert!(snapshot.scene.settings.scene_scale.is_some());
    commands.send(Command::Stop).unwrap();
    let trained = run.join().unwrap().unwrap();
    assert_eq!((trained.steps, &*kept.lock().unwrap()), (2, &vec![2]));

    // A queue without a sender gives no commands.
    let (_, queue) = command_queue();
    let config = TrainSettings {
        steps: 2,
        ..TrainSettings::default()
    };
    let trained = builder()
        .settings(config)
        .commands(queue)
        .build()
        .unwrap()
        .run();
    assert_eq!(trained.unwrap().steps, 2);
}

/// Makes one mistake, or grows by screen gradients alone.
#[derive(Clone, Copy, PartialEq)]
enum Wrong {
    WideTerm,
    EditBefore,
    AllRows,
    FirstOpacity,
    FailsAfterHook,
}

impl Strategy<Gaussians> for Wrong {
    fn first_gaussians(&self, settings: &InitSettings) -> InitSettings {
        match self {
            Self::FirstOpacity => settings.clone().with_opacity(2.0),
            _ => settings.clone(),
        }
    }

    fn loss_term_names(&self) -> Vec<String> {
        match self {
            Self::WideTerm => vec!["wide".into()],
            _ => vec![],
        }
    }

    fn loss_terms(&self, pass: &Pass<Gaussians>) -> Result<Vec<Tensor<1>>, OpError> {
        Ok(vec![pass.model.opacities()])
    }

    fn before_step(&mut self, context: &mut StepContext<Gaussians>) -> Result<(), OpError> {
        if *self == Self::EditBefore {
            let mut edit = RowEdit::identity(context.model.model().len());
            edit.relocate(0, 1, Moments::Keep);
            context.model.edit_rows(&edit)?;
        }
        Ok(())
    }

    fn after_step(
        &mut self,
        context: &mut StepContext<Gaussians>,
    ) -> Result<Option<Refinement>, OpError> {
        match self {
            Self::AllRows => context.model.edit_rows(&RowEdit::default())?,
            Self::FailsAfterHook if context.at.step == 3 => {
                return Err(OpError::Argument {
                    op: "strategy",
                    what: "no more".into(),
                });
            }
            _ => {}
        }
        Ok(None)
    }
}

/// A strategy's mistake ends the run with an error that names it, and no half step is saved.
#[test]
fn what_a_strategy_must_not_do_is_named() {
    let run = |strategy: Wrong| {
        let kept = Arc::new(Mutex::new(Vec::new()));
        let keep = kept.clone();
        let trainer =
            builder()
                .strategy(strategy)
                .autosave(Duration::from_secs(3600), move |checkpoint| {
                    keep.lock().unwrap().push(checkpoint.step());
                    Ok(())
                });
        let ended = trainer.build().and_then(Trainer::run).map(drop);
        assert!(kept.lock().unwrap().is_empty());
        ended.unwrap_err().to_string()
    };
    for (wrong, words) in [
        (Wrong::WideTerm, "one of [1]"),
        (Wrong::EditBefore, "edited rows in `before_step`"),
        (Wrong::AllRows, "no Gaussian would be left"),
        (Wrong::FirstOpacity, "`init.opacity`"),
        (Wrong::FailsAfterHook, "no more"),
    ] {
        let message = run(wrong);
        assert!(message.contains(words), "{message}");
    }
    let dropped = builder()
        .strategy(Wrong::AllRows)
        .model(Dimmed::new)
        .build();
    let message = dropped.map(drop).unwrap_err().to_string();
    assert!(message.contains("before the model"), "{message}");
}

/// Density control grows by the gradients of single views, however many a step has.
#[test]
fn density_control_sees_the_gradient_of_a_view_whatever_the_views_of_a_step() {
    struct Sums(Arc<Mutex<Vec<f32>>>);
    impl Strategy<Gaussians> for Sums {
        fn screen_wants(&self, _: &StepInfo) -> ScreenWants {
            ScreenWants::gradients()
        }
        fn before_step(&mut self, context: &mut StepContext<Gaussians>) -> Result<(), OpError> {
            let gradient = context.screen[0].gradient.clone().unwrap();
            let sum = gradient.abs().sum().into_scalar::<f32>();
            self.0.lock().unwrap().push(sum);
            Ok(())
        }
        fn after_step(
            &mut self,
            _: &mut StepContext<Gaussians>,
        ) -> Result<Option<Refinement>, OpError> {
            Ok(None)
        }
    }
    let first = |views: usize| {
        let seen = Arc::new(Mutex::new(Vec::new()));
        let settings = TrainSettings::new()
            .with_steps(1)
            .with_views_per_step(views);
        let trainer = builder().settings(settings).strategy(Sums(seen.clone()));
        trainer.build().unwrap().run().unwrap();
        let seen = seen.lock().unwrap();
        seen[0]
    };
    let (one, four) = (first(1), first(4));
    assert!((four / one - 1.0).abs() < 1e-4, "{one} {four}");
}

/// Numbers of hooks are restored exactly, and a run resumes only with its original hooks.
#[test]
fn hooks_are_part_of_the_run() {
    struct Number(f64);
    impl Hook for Number {
        fn name(&self) -> &str {
            "number"
        }
        fn save(&self) -> Result<StateRecord, OpError> {
            let mut record = StateRecord::default();
            record.scalars.insert("own.time".into(), 9usize.into());
            record.scalars.insert("value".into(), self.0.into());
            Ok(record)
        }
        fn restore(&mut self, record: StateRecord, _: &Device) -> Result<(), String> {
            let value = record.scalars.get("value").ok_or("`value` is missing")?;
            self.0 = f64::try_from(*value).map_err(|error| error.to_string())?;
            Ok(())
        }
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint.safetensors");
    let settings = || TrainSettings::new().with_steps(2);
    for value in [0.012702941391274987, f64::INFINITY] {
        let trainer = builder().settings(settings()).hook(Number(value));
        let trained = trainer.build().unwrap().run().unwrap();
        trained.checkpoint().unwrap().save(&path).unwrap();
        let resumed = builder().settings(settings()).hook(Number(0.0));
        let resumed = resumed
            .resume(Checkpoint::load(&path).unwrap())
            .build()
            .unwrap();
        let resumed = resumed.run().unwrap();
        assert_eq!(
            resumed.hook::<Number>().unwrap().0.to_bits(),
            value.to_bits()
        );
    }
    let without = builder()
        .settings(settings())
        .resume(Checkpoint::load(&path).unwrap());
    let message = without.build().map(drop).unwrap_err().to_string();
    assert!(message.contains("the hooks [\"number\"]"), "{message}");
}

/// A step beyond the run's last is an error, and the state can be saved between steps.
#[test]
fn whoever_drives_the_loop_ends_with_it() {
    let mut trainer = builder()
        .settings(TrainSettings::new().with_steps(2))
        .build()
        .unwrap();
    trainer.step().unwrap();
    assert_eq!(trainer.checkpoint().unwrap().step(), 1);
    trainer.step().unwrap();
    let message = trainer.step().unwrap_err().to_string();
    assert!(message.contains("all 2 steps"), "{message}");
}
