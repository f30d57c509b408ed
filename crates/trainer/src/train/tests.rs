//! Runs on the example capture.

mod calibration;
mod extensions;
mod sh_reduction;
mod sparse;
mod strategies;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use burn::tensor::Device;
use splat_data::{Capture, CaptureSettings};
use splat_ops::OpError;

use super::*;

fn capture() -> Arc<Capture> {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
    let options = CaptureSettings {
        downscale: 8,
        ..CaptureSettings::default()
    };
    Arc::new(Capture::load(folder, &options).unwrap())
}

fn builder() -> TrainerBuilder {
    builder_on(capture())
}

fn builder_on(capture: Arc<Capture>) -> TrainerBuilder {
    let config = TrainSettings {
        steps: 240,
        ..TrainSettings::default()
    };
    Trainer::builder(capture)
        .settings(config)
        .device(Device::flex())
}

/// Growth ends at the limit of the settings, or else at the default limit.
#[test]
fn the_photos_say_how_many_gaussians_are_worthwhile() {
    let most = |capture: Capture, config: TrainSettings| {
        let trainer = Trainer::builder(Arc::new(capture)).settings(config);
        let trainer = trainer.device(Device::flex()).build().unwrap();
        trainer.config.density.max_gaussians
    };
    let config = TrainSettings::default();
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
    // A quarter of the resolution for 60 steps, then half for another 60.
    let builder = || {
        builder().settings(TrainSettings {
            steps: 240,
            coarse_halvings: 2,
            coarse_every: 7_500,
            // These small photos have a limit below the number of points.
            max_gaussians_share: f64::INFINITY,
            ..TrainSettings::default()
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
    assert!(second.model.to_data() == whole.model.to_data());
    // Density control must have been involved.
    assert_ne!(whole.model.len(), capture().points.len());

    let mut damaged = first.checkpoint().unwrap();
    damaged.drop_row("model.quats");
    let error = builder().resume(damaged).build().map(drop);
    let error = error.unwrap_err().to_string();
    assert!(error.contains("`quats` has"), "{error}");

    // A single flipped bit is noticed.
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

/// A killed run resumes from its last autosave and ends the same.
#[test]
fn a_killed_run_goes_on_from_its_last_autosave() {
    let kept = Arc::new(Mutex::new(Vec::new()));
    let keep = kept.clone();
    let whole = builder()
        .autosave(Duration::ZERO, move |checkpoint| {
            keep.lock().unwrap().push(checkpoint.clone());
            Ok(())
        })
        .build()
        .unwrap()
        .run()
        .unwrap();
    let kept = kept.lock().unwrap();
    assert!(kept.len() > 200, "{} checkpoints", kept.len());
    let checkpoint = kept[kept.len() - 30].clone();
    assert!(checkpoint.step() < 240);
    let resumed = builder().resume(checkpoint).build().unwrap().run().unwrap();
    assert_eq!(resumed.history.losses, whole.history.losses);
    assert!(resumed.model.to_data() == whole.model.to_data());
}

/// Failed saves are reported once per kind and do not affect the run.
#[test]
fn a_run_outlives_its_autosaves() {
    let said = Arc::new(Mutex::new(Vec::new()));
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
                // As if a name differed each time.
                source: std::io::Error::new(kind, format!("attempt {count}")),
            })
        })
        .on_warning(move |warning| heard.lock().unwrap().push(warning.to_string()))
        .build()
        .unwrap()
        .run()
        .unwrap();
    assert_eq!(trained.steps, 240);
    let said = said.lock().unwrap();
    assert_eq!(said.len(), 2, "{said:?}");
    assert!(said[0].contains("there: attempt 1"), "{said:?}");
    // After a resume the failure should be reported again.
    assert!(trained.history.warnings.is_empty());
}

/// A run does not resume from another run: another capture, other settings, another loss. Photos
/// whose pixels alone have changed are named.
#[test]
fn a_short_run_has_higher_rates_unless_the_settings_say_otherwise() {
    let rates = |exponent: f64| {
        let mut settings = TrainSettings::new().with_steps(1_875);
        settings.learning_rates.short_run_exponent = exponent;
        let trainer = builder().settings(settings).build().unwrap();
        let rate = |name: &str| {
            let mut fields = trainer.state.model.fields().iter();
            fields.find(|field| field.name == name).unwrap().rate
        };
        ["means", "sh0", "opacity_logits"].map(rate)
    };
    assert_eq!(rates(0.0), [1.6e-4, 2.5e-3, 0.05]);
    assert_eq!(rates(0.5), [4.0 * 1.6e-4, 2.0 * 2.5e-3, 0.05]);
}

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
    let error = builder_on(Arc::new(other)).resume(checkpoint.clone());
    let error = error.build().err().map(|error| error.to_string());
    assert!(error.unwrap().contains("is not used, it was trained on"));
    let mut config = first.run.config.clone();
    config.learning_rates.sh0 *= 2.0;
    config.background = Some([1.0; 3]);
    let error = refusal(&|builder| builder.settings(config.clone())).unwrap();
    assert!(
        error.contains("background = absent") && error.contains("learning_rates.sh0"),
        "{error}"
    );
    let error = refusal(&|builder| {
        builder.loss(|_: &TargetView, rendered: &splat_model::ops::Rendered| {
            Ok(rendered.alpha().mean())
        })
    });
    assert!(error.unwrap().contains("a loss of the terms"));

    let said = Arc::new(Mutex::new(Vec::new()));
    let heard = said.clone();
    let mut other = Capture::clone(&capture());
    Arc::make_mut(&mut other.views[2].image).fill(9);
    let name = other.views[2].name.clone();
    let built = builder_on(Arc::new(other))
        .resume(checkpoint)
        .on_warning(move |warning| heard.lock().unwrap().push(warning.clone()))
        .build();
    assert!(built.is_ok());
    assert_eq!(
        *said.lock().unwrap(),
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
    let kept = Arc::new(Mutex::new(Vec::new()));
    let keep = kept.clone();
    let run = builder().loss(fails);
    let run = run.autosave(Duration::from_secs(3600), move |checkpoint| {
        keep.lock().unwrap().push(checkpoint.step());
        Ok(())
    });
    let error = run.build().unwrap().run().unwrap_err();
    assert!(matches!(error, TrainError::Op(_)), "{error}");
    assert_eq!(*kept.lock().unwrap(), [7]);
}

/// A photo with NaN loss and gradients is skipped, and leaves no trace in the scene or the
/// optimiser.
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
    let said = Arc::new(Mutex::new(Vec::new()));
    let heard = said.clone();
    let trained = builder()
        .loss(loss.clone())
        .on_warning(move |warning| heard.lock().unwrap().push(warning.clone()))
        .build()
        .unwrap()
        .run()
        .unwrap();
    assert_eq!(trained.steps, 240);
    let said = said.lock().unwrap().clone();
    let [Warning::LossNotFinite { view, step }] = &said[..] else {
        panic!("{said:?}");
    };
    assert_eq!(*view, bad);
    assert!(*step <= 28, "first seen at step {step}");
    assert_eq!(trained.history.warnings, said);
    // 240 steps are 8 rounds of 28 views and part of another.
    let recorded = trained.history.losses.len();
    assert!((231..=232).contains(&recorded), "{recorded} losses");
    let data = trained.model.to_data();
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

    // Warnings stay with the run and are not repeated.
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
