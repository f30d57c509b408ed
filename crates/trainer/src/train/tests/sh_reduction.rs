//! Fewer spherical harmonics in the middle of a run.

use splat_model::{FieldGradients, Gaussians, ShReductionSettings};

use super::*;

/// A run of 240 steps in which degrees are lowered at 120, if they are; Gaussians are added before
/// and after.
fn settings(strategy: StrategyKind) -> TrainSettings {
    let mut settings = TrainSettings::new()
        .with_steps(240)
        .with_strategy(strategy)
        .with_sh_degree_every(1_000)
        // Coefficients have learned little by then.
        .with_sh_reduction(
            ShReductionSettings::new()
                .with_std(0.005)
                .with_distance(0.005),
        );
    settings.set_max_gaussians(20_000);
    settings
}

fn whole(settings: &TrainSettings) -> Trained<Gaussians> {
    let trainer = builder().settings(settings.clone()).build();
    trainer.unwrap().run().unwrap()
}

fn stopped_at(settings: &TrainSettings, stop: usize) -> Trained<Gaussians> {
    let flag = Arc::new(AtomicBool::new(false));
    let raise = flag.clone();
    let trainer = builder()
        .settings(settings.clone())
        .interrupt(flag)
        .on_progress(move |state| raise.store(state.step >= stop, Ordering::Relaxed));
    trainer.build().unwrap().run().unwrap()
}

fn goes_on_as_if_it_had_not_stopped(settings: &TrainSettings) {
    let whole = whole(settings);
    let reduced = whole.history.sh_reduction.unwrap();
    assert!(reduced.step >= 120 && reduced.step < 180, "{reduced}");
    let lowered = reduced.gaussians;
    assert!(
        lowered[0] > 0 && lowered[3] < lowered.iter().sum(),
        "{reduced}"
    );
    let at_end = whole.model.sh_degrees();
    assert!(at_end.contains(&0) && at_end.len() == whole.model.len());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint.safetensors");
    for stop in [reduced.step - 5, reduced.step, 200] {
        let first = stopped_at(settings, stop);
        assert_eq!(first.steps, stop);
        assert_eq!(first.history.sh_reduction.is_some(), stop >= reduced.step);
        first.checkpoint().unwrap().save(&path).unwrap();
        let resumed = builder().settings(settings.clone());
        let resumed = resumed.resume(Checkpoint::load(&path).unwrap());
        let second = resumed.build().unwrap().run().unwrap();
        assert_eq!(second.history.losses, whole.history.losses, "{stop}");
        assert_eq!(second.history.sh_reduction, Some(reduced));
        assert_eq!(second.model.sh_degrees(), at_end);
        assert!(second.model.to_data() == whole.model.to_data());
    }
}

#[test]
fn density_control_goes_on_with_fewer_harmonics() {
    goes_on_as_if_it_had_not_stopped(&settings(StrategyKind::Adc));
}

#[test]
fn mcmc_goes_on_with_fewer_harmonics() {
    goes_on_as_if_it_had_not_stopped(&settings(StrategyKind::Mcmc));
}

#[test]
fn improved_gs_goes_on_with_fewer_harmonics() {
    let mut settings = settings(StrategyKind::Improved);
    settings.improved.grow_gradient = 0.0;
    settings.improved.fill_gradient = 0.0;
    goes_on_as_if_it_had_not_stopped(&settings);
}

/// Sparse steps end with the reduction, and the run does not.
#[test]
fn steps_of_seen_rows_end_with_the_reduction() {
    let settings = settings(StrategyKind::Adc).with_sparse_share(1.0);
    let trained = whole(&settings);
    assert!(trained.history.sh_reduction.is_some() && trained.steps == 240);
}

/// All of degree 0: fourteen numbers each, forward, backward and in Adam.
#[test]
fn gaussians_of_one_colour_train_fourteen_numbers() {
    let reduction = ShReductionSettings::new().with_std(f64::INFINITY);
    let settings = settings(StrategyKind::Adc).with_sh_reduction(reduction);
    let mut trainer = builder().settings(settings).build().unwrap();
    while trainer.state.history.sh_reduction.is_none() {
        trainer.step().unwrap();
    }
    trainer.step().unwrap();
    let n = trainer.state.model.count();
    let all = trainer.state.model.save().unwrap();
    let numbers = |fits: &dyn Fn(&str) -> bool| -> usize {
        let tensors = all.tensors.iter().filter(|(name, _)| fits(name));
        tensors.map(|(_, data)| data.num_elements()).sum()
    };
    assert_eq!(numbers(&|name| !name.contains(['.', '/'])), 14 * n);
    for moment in [".moment_1", ".moment_2"] {
        assert_eq!(numbers(&|name| name.ends_with(moment)), 14 * n);
    }
    let whole = trainer.state.model.whole();
    let center = burn::tensor::Tensor::ones([1, 3], &trainer.device);
    let colors = whole.model().colors(center, 3, None).unwrap();
    let found: FieldGradients = whole.gradients(&mut colors.sum().backward());
    assert!(!found.contains_key("sh_rest"));
}

/// The highest degree comes after three passes over the photos, or the share is beyond the last
/// step.
#[test]
fn a_run_that_is_too_short_for_a_reduction_says_so() {
    let warned = |steps: usize, at: f64| {
        let warnings = Arc::new(Mutex::new(Vec::new()));
        let said = warnings.clone();
        let settings = settings(StrategyKind::Adc)
            .with_steps(steps)
            .with_sh_reduction(ShReductionSettings::new().with_at(at));
        let trainer = builder().settings(settings);
        let trainer = trainer.on_warning(move |warning| said.lock().unwrap().push(warning.clone()));
        let trained = trainer.build().unwrap().run().unwrap();
        let warned = warnings
            .lock()
            .unwrap()
            .contains(&Warning::ShReductionNeverDue);
        assert_eq!(trained.history.sh_reduction.is_none(), warned);
        warned
    };
    assert_eq!(
        [(20, 0.0), (100, 0.5), (100, 0.999)].map(|(steps, at)| warned(steps, at)),
        [true, false, true]
    );
}

/// Nothing of it is in a run that does not ask for it.
#[test]
fn a_run_without_a_reduction_has_gaussians_of_one_degree() {
    let mut settings = settings(StrategyKind::Adc).with_steps(60);
    settings.sh_reduction = None;
    let trained = whole(&settings);
    assert!(trained.model.sh_starts.is_none() && trained.history.sh_reduction.is_none());
    // As another run it is refused.
    let checkpoint = trained.checkpoint().unwrap();
    let other = settings.with_sh_reduction(ShReductionSettings::new());
    let refused = builder().settings(other).resume(checkpoint).build();
    let message = refused.map(drop).unwrap_err().to_string();
    assert!(message.contains("sh_reduction"), "{message}");
}
