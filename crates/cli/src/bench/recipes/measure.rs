//! One run: trained, scored and weighed.

use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use burn::tensor::Device;

use super::pictures;
use super::plan::Run;
use super::row::Row;
use crate::report::progress::Progress;
use crate::{Failure, GlobalArgs};
use splat_data::{Capture, SplatData, View, WriteError, scene};
use splat_trainer::{Scores, TrainError, Trained, Trainer};

/// Share of the time of a run within which its held-out views are measured.
const SHARE: f64 = 0.02;
/// Measuring a view takes about as long as so many steps: it is rendered and compared, without a
/// gradient, which is less than half of a step.
const STEPS_PER_VIEW: f64 = 0.5;
/// The held-out views are measured at most this many times during a run.
const MOST_MEASUREMENTS: usize = 10;
/// The seed of the runs of which there are pictures.
const PICTURED_SEED: u64 = 0;

/// Where and how runs are measured.
pub(super) struct Bench<'a> {
    /// The folder of the results.
    pub folder: &'a Path,
    pub device: &'a Device,
    /// Becomes true at Ctrl-C.
    pub interrupt: Arc<AtomicBool>,
    pub global: &'a GlobalArgs,
}

/// How a run ended.
pub(super) enum Outcome {
    Measured(Box<Row>),
    Interrupted,
    /// It has no result, for this reason.
    Failed(String),
}

impl Bench<'_> {
    /// Makes a run and measures it. What it takes `since` then is its time, in training or outside
    /// of it. `pictured` is the view of which other runs have pictures.
    pub(super) fn measure(
        &self,
        run: &Run,
        capture: &Arc<Capture>,
        pictured: Option<&str>,
        since: Instant,
    ) -> Result<Outcome, Failure> {
        let failed = |error: Failure| Ok(Outcome::Failed(format!("{run}: {}", error.reason())));
        let (trained, mut curve) = match self.train(run, capture) {
            Ok(trained) => trained,
            Err(error) => return failed(error.into()),
        };
        if trained.steps < run.key.steps {
            return Ok(Outcome::Interrupted);
        }
        let views: Vec<&View> = capture.test_views().collect();
        let scores = match trained.evaluate(&views, self.device, |_, _| {}) {
            Ok(scores) => scores,
            Err(error) => return failed(error.into()),
        };
        let view = match run.key.seed {
            PICTURED_SEED => self.picture(run, &trained, &views, &scores, pictured)?,
            _ => None,
        };
        let seconds = trained.elapsed.as_secs_f64();
        if curve.is_empty() {
            curve.push((seconds, scores.psnr));
        }
        let counts = trained.history.counts.iter().map(|(_, count)| *count);
        let gaussians = trained.model.len();
        let [ply_bytes, spz_bytes] = self.file_sizes(trained.to_data())?;
        Ok(Outcome::Measured(Box::new(Row {
            key: run.key.clone(),
            digest: run.digest(),
            psnr: scores.psnr,
            ssim: scores.ssim,
            gaussians,
            most_gaussians: counts.fold(gaussians, usize::max),
            seconds,
            outside_seconds: since.elapsed().as_secs_f64() - seconds,
            ply_bytes,
            spz_bytes,
            view,
            curve,
        })))
    }

    /// Trains, and returns what held-out PSNR was reached after how many seconds of training.
    fn train(
        &self,
        run: &Run,
        capture: &Arc<Capture>,
    ) -> Result<(Trained, Vec<(f64, f64)>), TrainError> {
        let settings = run.settings();
        let steps = settings.steps;
        let course = Arc::new(Mutex::new(Course {
            bar: Progress::new(steps as u64, 0, self.global.quiet),
            curve: Vec::new(),
        }));
        let [shown, noted] = [&course, &course].map(Arc::clone);
        let mut trainer = Trainer::builder(Arc::clone(capture))
            .settings(settings)
            .device(self.device.clone())
            .interrupt(Arc::clone(&self.interrupt))
            .on_warning(move |warning| lock(&noted).bar.note(&format!("warning: {warning}")))
            .on_progress(move |state| lock(&shown).follow(&state));
        if let Some(every) = interval(steps, capture.split.test.len()) {
            trainer = trainer.evaluate_every(every);
        }
        let trained = trainer.build()?.run();
        let course = lock(&course);
        course.bar.finish();
        Ok((trained?, course.curve.clone()))
    }

    /// Keeps what a run makes of a held-out view, `pictured` or else the one that it scores worst,
    /// and returns the name of the view.
    fn picture(
        &self,
        run: &Run,
        trained: &Trained,
        views: &[&View],
        scores: &Scores,
        pictured: Option<&str>,
    ) -> Result<Option<String>, Failure> {
        let named = |name: &str| views.iter().find(|view| view.name == name);
        let view = pictured.and_then(named);
        let Some(view) = view.or_else(|| worst(scores).and_then(named)) else {
            return Ok(None);
        };
        let mut written = Ok(());
        trained.evaluate(&[*view], self.device, |view, rendered| {
            written = pictures::keep(self.folder, &run.key, view, &rendered);
        })?;
        written?;
        Ok(Some(view.name.clone()))
    }

    /// Bytes of a scene as PLY and as SPZ, from files that are removed again.
    fn file_sizes(&self, mut scene: SplatData) -> Result<[u64; 2], Failure> {
        // SPZ has no room for an origin, and its size does not depend on it.
        scene.origin = [0.0; 3];
        let io_error = |source| WriteError {
            path: self.folder.to_owned(),
            source,
        };
        let temporary = tempfile::Builder::new()
            .prefix("scene")
            .tempdir_in(self.folder)
            .map_err(io_error)?;
        let mut sizes = [0; 2];
        for (size, name) in sizes.iter_mut().zip(["scene.ply", "scene.spz"]) {
            let path = temporary.path().join(name);
            scene::write(&path, &scene)?;
            *size = std::fs::metadata(&path).map_err(io_error)?.len();
        }
        temporary.close().map_err(io_error)?;
        Ok(sizes)
    }
}

/// The bar of a run, and its curve so far.
struct Course {
    bar: Progress,
    /// Held-out PSNR after so many seconds of training.
    curve: Vec<(f64, f64)>,
}

impl Course {
    /// Shows a step, and keeps the PSNR if it was measured after it.
    fn follow(&mut self, state: &splat_trainer::Progress<'_>) {
        let measured = &state.history.held_out_psnr;
        if let Some((_, psnr)) = measured.get(self.curve.len()) {
            self.curve.push((state.elapsed.as_secs_f64(), *psnr));
        }
        self.bar.update(state.step as u64, || {
            let psnr = self.curve.last();
            let psnr = psnr.map_or_else(String::new, |(_, psnr)| format!("{psnr:.2} dB  "));
            format!("{psnr}{} Gaussians", state.gaussians)
        });
    }
}

/// The course, whatever became of another thread that had it.
fn lock(course: &Mutex<Course>) -> MutexGuard<'_, Course> {
    course.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Steps between two measurements of so many held-out views during a run, if there is time for more
/// than the one at the end, which gives the scores.
fn interval(steps: usize, views: usize) -> Option<usize> {
    let affordable = SHARE * steps as f64 / (STEPS_PER_VIEW * views as f64);
    let during = (affordable as usize).saturating_sub(1);
    let during = during.min(MOST_MEASUREMENTS);
    (during > 1).then(|| steps.div_ceil(during))
}

/// Name of the view with the lowest PSNR.
fn worst(scores: &Scores) -> Option<&str> {
    let views = scores.views.iter().filter(|view| !view.psnr.is_nan());
    let worst = views.min_by(|a, b| a.psnr.total_cmp(&b.psnr));
    worst.map(|view| view.name.as_str())
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_trainer::ViewScore;

    #[test]
    fn held_out_views_are_measured_as_often_as_there_is_time_for() {
        assert_eq!(interval(20, 4), None);
        assert_eq!(interval(2_000, 4), Some(200));
        assert_eq!(interval(30_000, 25), Some(3_000));
        assert_eq!(interval(7_000, 38), Some(1_167));
        assert_eq!(interval(2_000, 38), None);
        // Those during the run and the one at its end.
        for (steps, views) in [(1_000, 4), (2_000, 10), (3_000, 25), (30_000, 100)] {
            let during = interval(steps, views).map_or(0, |every| steps.div_ceil(every));
            let taken = STEPS_PER_VIEW * (views * (during + 1)) as f64;
            assert!(
                taken <= SHARE * steps as f64,
                "{steps} steps, {views} views"
            );
        }
    }

    #[test]
    fn the_worst_view_has_a_score() {
        let view = |name: &str, psnr| ViewScore {
            name: name.to_owned(),
            psnr,
            ssim: 0.5,
        };
        let views = vec![view("a", 20.0), view("b", f64::NAN), view("c", 19.0)];
        assert_eq!(worst(&Scores::of_views(views)), Some("c"));
        assert_eq!(worst(&Scores::of_views(vec![])), None);
    }
}
