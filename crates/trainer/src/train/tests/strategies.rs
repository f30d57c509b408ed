//! The strategies of the settings: each trains, and resumes to the same end.

use super::*;

/// Improved-GS in a run of two refinements, with a selection after them or none.
fn improved(final_gaussians: Option<usize>) -> TrainSettings {
    let mut settings = settings(StrategyKind::Improved, false).with_steps(480);
    // Few steps and small photos: whatever is seen may be split.
    settings.improved.grow_gradient = 0.0;
    settings.improved.fill_gradient = 0.0;
    settings.improved.selection.final_gaussians = final_gaussians;
    settings
}

fn settings(strategy: StrategyKind, absgrad: bool) -> TrainSettings {
    let mut settings = TrainSettings::new().with_steps(240).with_strategy(strategy);
    settings.density.absgrad = absgrad;
    // Few steps and small photos: something is to grow all the same.
    settings.set_max_gaussians(20_000);
    settings.density.grow_gradient = absgrad.then_some(1e-4);
    settings
}

/// A whole run, a run that is stopped after a refinement and goes on from its file.
fn goes_on_as_if_it_had_not_stopped(settings: &TrainSettings) {
    goes_on_from(settings, 150);
}

/// The same with a stop after so many steps.
fn goes_on_from(settings: &TrainSettings, stop: usize) {
    let builder = || builder().settings(settings.clone());
    let whole = builder().build().unwrap().run().unwrap();
    assert_ne!(
        whole.model.len(),
        capture().points.len(),
        "nothing was added"
    );

    let flag = Arc::new(AtomicBool::new(false));
    let raise = flag.clone();
    let first = builder()
        .interrupt(flag)
        .on_progress(move |state| raise.store(state.step >= stop, Ordering::Relaxed));
    let first = first.build().unwrap().run().unwrap();
    assert_eq!(first.steps, stop);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint.safetensors");
    first.checkpoint().unwrap().save(&path).unwrap();
    let resumed = builder().resume(Checkpoint::load(&path).unwrap());
    let second = resumed.build().unwrap().run().unwrap();
    assert_eq!(second.history.losses, whole.history.losses);
    assert!(second.model.to_data() == whole.model.to_data());
    assert_eq!(second.history.counts, whole.history.counts);

    // As another strategy it is another run.
    let mut other = settings.clone();
    match other.strategy {
        StrategyKind::Adc => other.density.absgrad = !other.density.absgrad,
        StrategyKind::Mcmc | StrategyKind::Improved => other.strategy = StrategyKind::Adc,
    }
    let checkpoint = Checkpoint::load(&path).unwrap();
    let refused = super::builder().settings(other).resume(checkpoint).build();
    let message = refused.map(drop).unwrap_err().to_string();
    assert!(
        message.contains("absgrad") || message.contains("strategy"),
        "{message}"
    );
}

#[test]
fn absgrad_trains_and_resumes() {
    goes_on_as_if_it_had_not_stopped(&settings(StrategyKind::Adc, true));
}

#[test]
fn mcmc_trains_and_resumes() {
    goes_on_as_if_it_had_not_stopped(&settings(StrategyKind::Mcmc, false));
}

/// Stopped between two refinements, with gradients measured in part.
#[test]
fn improved_gs_trains_and_resumes() {
    goes_on_from(&improved(None), 190);
}

/// Stopped in the middle of selection, whose weight has been controlled.
#[test]
fn selection_trains_and_resumes() {
    goes_on_from(&improved(Some(capture().points.len() + 500)), 301);
}

/// Growth ends at the limit, selection at the number that is to survive, before the run does.
#[test]
fn improved_gs_reaches_its_limit_and_selection_its_own() {
    let points = capture().points.len();
    let mut settings = improved(None);
    settings.set_max_gaussians(points + 100);
    let run = |settings: TrainSettings| builder().settings(settings).build().unwrap().run();
    let trained = run(settings).unwrap();
    assert_eq!(trained.model.len(), points + 100);

    let survivors = points / 2;
    let trained = run(improved(Some(survivors))).unwrap();
    assert_eq!(trained.model.len(), survivors);
    let counts = &trained.history.counts;
    let most = counts.iter().map(|(_, count)| *count).max().unwrap();
    assert!(survivors < most && most <= 3 * survivors, "{counts:?}");
    let (last, _) = counts.last().unwrap();
    assert!((240..=368).contains(last), "{counts:?}");
    let terms = &trained.history.terms;
    assert_eq!(terms.last().unwrap(), "opacity pressure");
    let pressed = trained.history.losses.iter();
    let pressed = pressed.filter(|loss| loss.terms.last().is_some_and(|term| *term > 0.0));
    let steps: Vec<usize> = pressed.map(|loss| loss.step).collect();
    assert_eq!((steps[0], steps[1]), (241, 251), "{steps:?}");
}

/// The terms that MCMC adds to the loss are logged, and growth ends at the cap.
#[test]
fn mcmc_logs_its_terms_and_keeps_its_cap() {
    let mut settings = settings(StrategyKind::Mcmc, false);
    let points = capture().points.len();
    settings.set_max_gaussians(points + 10);
    let trained = builder().settings(settings).build().unwrap().run().unwrap();
    assert_eq!(trained.model.len(), points + 10);
    let terms = &trained.history.terms;
    assert_eq!(terms[terms.len() - 2..], ["opacity", "scale"]);
    let first = &trained.history.losses[0].terms;
    // A hundredth of the opacity that all have at first.
    assert!((first[first.len() - 2] - 0.005).abs() < 1e-6, "{first:?}");
}

/// What a run writes down as its settings is read as the same strategy.
#[test]
fn settings_name_the_strategy() {
    for strategy in [
        StrategyKind::Adc,
        StrategyKind::Mcmc,
        StrategyKind::Improved,
    ] {
        let settings = settings(strategy, true);
        let text = toml::to_string(&settings).unwrap();
        assert_eq!(TrainSettings::parse(text.as_bytes()), Ok(settings));
    }
    let text = b"strategy = \"mcmc\"\n[mcmc]\nmax_gaussians = 7\n";
    assert_eq!(TrainSettings::parse(text).unwrap().max_gaussians(), Some(7));
    let text = b"strategy = \"improved\"\n[improved.selection]\nfinal_gaussians = 7\n";
    let settings = TrainSettings::parse(text).unwrap();
    assert_eq!(settings.improved.selection.final_gaussians, Some(7));
    let message = TrainSettings::parse(b"strategy = \"best\"").unwrap_err();
    assert!(
        message.contains("`adc`") && message.contains("`mcmc`"),
        "{message}"
    );
}
