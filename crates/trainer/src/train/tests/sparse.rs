//! Steps that leave out what their views do not see.

use splat_model::optimizer::StateRecord;
use splat_model::strategy::{Refinement, RowsNeeded, SparseStep, StepContext, StepInfo, Strategy};
use splat_model::{Gaussians, RowEdit, SplatModel};

use super::*;

/// Gaussians stay as many as they are.
struct Still;

impl<M: SplatModel> Strategy<M> for Still {
    fn rows_needed(&self, _: &StepInfo) -> RowsNeeded {
        RowsNeeded::Seen
    }
    fn after_step(&mut self, _: &mut StepContext<M>) -> Result<Option<Refinement>, OpError> {
        Ok(None)
    }
}

fn settings(sparse_share: f64, steps: usize) -> TrainSettings {
    TrainSettings::new()
        .with_steps(steps)
        .with_sparse_share(sparse_share)
}

/// A run in small groups of neighbours, so that each view of the small capture leaves out some.
fn in_small_groups(builder: TrainerBuilder) -> Trainer {
    let mut trainer = builder.build().unwrap();
    let whole = trainer.state.model.whole();
    let [means] = whole.read_f64(["means"]).unwrap();
    let means = means.as_chunks().0;
    let mut edit = RowEdit::identity(means.len());
    edit.arrange(means);
    whole.edit_rows(&edit).unwrap();
    trainer.state.model = trainer.state.model.with_group_size(4);
    trainer
}

/// Share of the Gaussians that the views see, on average.
fn seen(trainer: &mut Trainer) -> f64 {
    let at = StepInfo {
        step: 0,
        run: trainer.schedule,
    };
    let project = trainer.render_settings(&at).project;
    let origin = trainer.state.model.origin();
    let views: Vec<_> = trainer.capture.train_views().collect();
    let shares = views.iter().map(|view| {
        let camera = view.camera().relative_to(origin);
        let rows = trainer.state.model.seen(&[camera], &project).unwrap();
        rows.len() as f64 / rows.count() as f64
    });
    shares.sum::<f64>() / views.len() as f64
}

fn values(model: &Gaussians) -> [Vec<f32>; 3] {
    let data = model.to_data();
    [
        data.means.into_flattened(),
        data.log_scales.into_flattened(),
        data.sh0.into_flattened(),
    ]
}

/// Root of the mean squared difference of each field.
fn differences(a: &Gaussians, b: &Gaussians) -> [f64; 3] {
    let (a, b) = (values(a), values(b));
    core::array::from_fn(|i| {
        let squares = (a[i].iter().zip(&b[i])).map(|(a, b)| f64::from(a - b).powi(2));
        (squares.sum::<f64>() / a[i].len() as f64).sqrt()
    })
}

/// After 300 steps both runs are at the same place, up to what 300 steps make of rounding. A run
/// with another order of additions is the measure: that of one with another seed would be far off.
#[test]
fn three_hundred_steps_of_seen_rows_are_as_good_as_of_all() {
    let run = |share: f64, steps: usize| {
        let settings = settings(share, 300);
        let mut trainer = in_small_groups(builder().settings(settings).strategy(Still));
        let seen = seen(&mut trainer);
        assert!(
            (0.05..0.97).contains(&seen),
            "views see {seen} of the Gaussians"
        );
        for _ in 0..steps {
            trainer.step().unwrap();
        }
        trainer
    };
    for (steps, most) in [(30, 1e-5), (300, 2e-2)] {
        let (all, some) = (run(0.0, steps), run(1.0, steps));
        let difference = differences(&all.model(), &some.model());
        let moved = differences(&all.model(), &run(0.0, 0).model());
        eprintln!("after {steps} steps {difference:?} apart, having moved {moved:?}");
        for (difference, moved) in difference.iter().zip(moved) {
            assert!(difference / moved < most, "{difference} of {moved}");
        }
    }
}

/// A run with rows that are behind goes on from a checkpoint with the same bits, and neither
/// checkpoints nor looks at the model on the way change anything.
#[test]
fn a_run_resumes_with_rows_that_are_behind() {
    let settings = || settings(1.0, 240);
    let whole = in_small_groups(builder().settings(settings()));
    let whole = whole.run().unwrap();
    // Growth was involved.
    assert_ne!(whole.model.len(), capture().points.len());

    let flag = Arc::new(AtomicBool::new(false));
    let raise = flag.clone();
    let kept = Arc::new(Mutex::new(0));
    let keep = kept.clone();
    let first = builder()
        .settings(settings())
        .interrupt(flag)
        .evaluate_every(7)
        .autosave(Duration::ZERO, move |_| {
            *keep.lock().unwrap() += 1;
            Ok(())
        })
        .on_progress(move |state| raise.store(state.step >= 153, Ordering::Relaxed));
    let first = in_small_groups(first).run().unwrap();
    assert!(*kept.lock().unwrap() > 100);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint.safetensors");
    first.checkpoint().unwrap().save(&path).unwrap();
    let checkpoint = Checkpoint::load(&path).unwrap();
    let resumed = builder().settings(settings()).resume(checkpoint);
    let second = resumed.build().unwrap();
    let behind = second.state.model.save().unwrap();
    assert!(behind.tensors.contains_key("sparse/rows.taken"));
    let second = second.run().unwrap();
    assert_eq!(second.history.losses, whole.history.losses);
    assert!(second.model.to_data() == whole.model.to_data());
    assert_eq!(second.history.counts, whole.history.counts);

    // With another share it is another run.
    let checkpoint = Checkpoint::load(&path).unwrap();
    let other = settings().with_sparse_share(0.0);
    let refused = builder().settings(other).resume(checkpoint).build();
    let message = refused.map(drop).unwrap_err().to_string();
    assert!(message.contains("sparse_share"), "{message}");
}

/// A strategy that was written before there were steps of some rows has all of them at every step.
#[test]
fn a_strategy_that_says_nothing_has_all_rows_at_every_step() {
    struct Reads(Arc<Mutex<Vec<(usize, usize)>>>);
    impl<M: SplatModel> Strategy<M> for Reads {
        fn sparse_step(&mut self, _: &mut SparseStep) -> Result<(), OpError> {
            panic!("a step of some rows")
        }
        fn before_step(&mut self, context: &mut StepContext<M>) -> Result<(), OpError> {
            let rows = context.gradients["means"].dims()[0];
            let read = (rows, context.model.model().count());
            self.0.lock().unwrap().push(read);
            Ok(())
        }
        fn after_step(&mut self, _: &mut StepContext<M>) -> Result<Option<Refinement>, OpError> {
            Ok(None)
        }
    }
    let read = Arc::new(Mutex::new(Vec::new()));
    let settings = settings(1.0, 20);
    let reads = Reads(read.clone());
    let trained = in_small_groups(builder().settings(settings).strategy(reads));
    let trained = trained.run().unwrap();
    let read = read.lock().unwrap();
    assert_eq!(*read, [(trained.model.len(), trained.model.len()); 20]);
    let saved: StateRecord = trained.state.model.save().unwrap();
    assert!(!saved.tensors.contains_key("sparse/rows.taken"));
}

/// The statistics of density control are the same, and so is what it does.
#[test]
fn density_control_grows_the_same_gaussians() {
    let counts = |share: f64| {
        let mut settings = settings(share, 480);
        settings.density.start = 50;
        let trainer = in_small_groups(builder().settings(settings));
        let flag = trainer.watch.interrupt.clone();
        let mut trainer = trainer;
        trainer.watch.on_progress = Box::new(move |state| {
            flag.store(state.step >= 110, Ordering::Relaxed);
        });
        let counts = trainer.run().unwrap().history.counts;
        counts.last().copied().unwrap()
    };
    let ((at, all), (_, some)) = (counts(0.0), counts(1.0));
    assert_eq!(at, 100);
    let difference = all.abs_diff(some) as f64 / all as f64;
    assert!(difference < 2e-3, "{all} and {some}");
    assert_ne!(all, capture().points.len());
}

#[test]
fn shares_are_checked() {
    for share in [-0.1, 1.1, f64::NAN] {
        let message = settings(share, 10).validate().unwrap_err();
        assert!(message.contains("`sparse_share`"), "{message}");
    }
    assert!(settings(1.0, 10).validate().is_ok());
}
