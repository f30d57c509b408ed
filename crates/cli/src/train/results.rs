//! The output folder of a run: checked before the first step, and written to when the run ends or
//! is interrupted.
//!
//! The most valuable files come first: the scene, then the checkpoint, then files that can be
//! recomputed from them. If one cannot be saved, the rest are still tried. The checkpoint is
//! removed only once everything else has been saved.

use std::path::{Path, PathBuf};
use std::time::Duration;

use splat_data::scene::ply;

use super::super::command_line::CommandLine;
use super::super::device::ChosenDevice;
use super::super::{Failure, GlobalArgs};
use crate::report::curves::Curves;
use crate::report::losses::write_losses;
use crate::report::metrics::{Metrics, write_json};
use crate::report::png::Picture;
use crate::report::view_names::ViewNames;
use crate::report::{ReportError, probe_file, probe_folder, refuse_inputs, write_durably};
use splat_data::{Capture, View, WriteError};
use splat_lab::memory::peak_rss_bytes;
use splat_trainer::Scores;
use splat_trainer::calibration::AlignedScores;
use splat_trainer::{CheckpointError, History, TrainSettings, Trained};

/// The scene's file.
pub(super) const SCENE: &str = "scene.ply";
/// The checkpoint's file.
pub(super) const CHECKPOINT: &str = "checkpoint.safetensors";
/// The settings' file.
pub(super) const CONFIG: &str = "config.toml";
/// The figures' file, written last.
pub(super) const METRICS: &str = "metrics.json";
const LOSSES: &str = "losses.csv";
const CURVES: &str = "curves.svg";
/// The folder of refined cameras, a COLMAP model.
pub(crate) const CAMERAS: &str = "cameras";
/// The folder of undistorted photos with their cameras.
pub(crate) const UNDISTORTED: &str = "undistorted";
/// The pictures' folder.
const VIEWS: &str = "views";

/// Where a run writes its results.
pub(super) struct RunFolder<'a> {
    pub folder: &'a Path,
    /// Contents of `config.toml`.
    pub config: &'a str,
    /// The command that resumes the run.
    pub resume: &'a CommandLine,
    /// Whether undistorted photos are written too.
    pub undistort: bool,
    pub global: &'a GlobalArgs,
}

/// Files that were saved, and files that were not, with the reason.
#[derive(Default)]
struct Saving {
    saved: Vec<&'static str>,
    failed: Vec<(&'static str, String)>,
}

impl Saving {
    fn keep<E: Into<Failure>>(&mut self, name: &'static str, outcome: Result<(), E>) -> bool {
        let saved = outcome.is_ok();
        match outcome {
            Ok(()) => self.saved.push(name),
            Err(error) => self.failed.push((name, error.into().reason())),
        }
        saved
    }
}

/// The views with the cameras that the run has refined.
fn refined_views(trained: &Trained, capture: &Capture) -> Result<Vec<View>, Failure> {
    let cameras = trained.cameras(capture)?;
    let views = capture.views.iter().zip(&cameras);
    Ok(views
        .map(|(view, camera)| view.with_camera(camera))
        .collect())
}

fn with_views(capture: &Capture, views: Vec<View>) -> Capture {
    Capture {
        views,
        ..capture.clone()
    }
}

impl RunFolder<'_> {
    /// Checks that everything can be written, before there is anything to lose, and without
    /// replacing a photo.
    pub(super) fn probe(&self, capture: &Capture) -> Result<(), ReportError> {
        let pictures = picture_names(capture).stems;
        let pictures = pictures.iter().map(|stem| self.picture(stem));
        let photos = capture.photo_files();
        refuse_inputs(pictures, photos.iter().map(PathBuf::as_path))?;
        probe_folder(self.folder)?;
        for name in [SCENE, CHECKPOINT, CONFIG, METRICS, LOSSES, CURVES] {
            probe_file(&self.folder.join(name))?;
        }
        for name in [VIEWS, CAMERAS] {
            let folder = self.folder.join(name);
            if folder.exists() {
                probe_folder(&folder)?;
            }
        }
        Ok(())
    }

    /// Undistorted photos of an earlier run, which are not replaced.
    pub(super) fn undistorted_before(&self) -> Option<PathBuf> {
        let folder = self.folder.join(UNDISTORTED);
        (self.undistort && folder.exists()).then_some(folder)
    }

    /// Says that undistorted photos of an earlier run stay, if they do.
    pub(super) fn note_undistorted(&self) {
        let folder = self.folder.join(UNDISTORTED);
        if !self.undistort && folder.exists() {
            self.global.say(format_args!(
                "warning: {}: of an earlier run, and not of this scene; it stays as it is",
                folder.display()
            ));
        }
    }

    /// The picture of a view.
    fn picture(&self, stem: &str) -> PathBuf {
        self.folder.join(VIEWS).join(format!("{stem}.png"))
    }

    /// True if the results of another run are here.
    pub(super) fn is_taken(&self) -> bool {
        [SCENE, METRICS]
            .iter()
            .any(|name| self.folder.join(name).exists())
    }

    /// Error of a run that could not continue, with the command to resume from its saved state.
    pub(super) fn stopped(&self, error: Failure) -> Failure {
        if !self.folder.join(CHECKPOINT).is_file() {
            return error;
        }
        Failure::BadInput(format!(
            "{}; what was done before is kept, go on with: {}",
            error.reason(),
            self.resume
        ))
    }

    /// Saves an interrupted run.
    pub(super) fn interrupted(
        &self,
        trained: &Trained,
        capture: &Capture,
        config: &TrainSettings,
    ) -> Result<(), Failure> {
        let mut saving = Saving::default();
        let scene = self.save_scene(&mut saving, trained);
        saving.keep(CHECKPOINT, self.save_checkpoint(trained));
        if scene && config.calibration.is_on() {
            // Held-out views are aligned once the run is complete.
            let saved =
                refined_views(trained, capture).and_then(|views| self.save_refined(capture, views));
            saving.keep(CAMERAS, saved);
        }
        self.save_course(&mut saving, trained, scene);
        self.note_other_pictures(&[]);
        self.outcome(saving)
    }

    /// Saves a complete run, measures it, and removes its checkpoint. Returns the figures, if they
    /// could be measured, and whether everything could be saved.
    pub(super) fn complete(
        &self,
        trained: &Trained,
        capture: &Capture,
        config: &TrainSettings,
        chosen: &ChosenDevice,
    ) -> (Option<Metrics>, Result<(), Failure>) {
        let mut saving = Saving::default();
        let scene = self.save_scene(&mut saving, trained);
        if !scene && self.folder.join(SCENE).exists() {
            // Beside the scene of another run, only the checkpoint of this one may be written.
            saving.keep(CHECKPOINT, self.save_checkpoint(trained));
            return (None, self.outcome(saving));
        }
        self.save_course(&mut saving, trained, scene);
        let scores = self.save_views(&mut saving, trained, capture, chosen);
        let aligned = self.save_cameras(&mut saving, trained, capture, config, chosen);
        let metrics = scores.map(|scores| Metrics {
            aligned,
            ..metrics(&scores, trained, config, chosen)
        });
        if let Some(metrics) = &metrics {
            saving.keep(METRICS, write_json(&self.folder.join(METRICS), metrics));
        }
        if saving.failed.is_empty() {
            return (metrics, self.remove_checkpoint());
        }
        saving.keep(CHECKPOINT, self.save_checkpoint(trained));
        (metrics, self.outcome(saving))
    }

    /// Saves the scene. Figures and refined cameras of an earlier scene are removed.
    fn save_scene(&self, saving: &mut Saving, trained: &Trained) -> bool {
        let path = self.folder.join(SCENE);
        let saved = saving.keep(SCENE, ply::write(&path, &trained.to_data()));
        if saved {
            let _ = std::fs::remove_file(self.folder.join(METRICS));
            for file in ["cameras.bin", "images.bin", "points3D.bin"] {
                let _ = std::fs::remove_file(self.folder.join(CAMERAS).join(file));
            }
        }
        saved
    }

    fn save_checkpoint(&self, trained: &Trained) -> Result<(), CheckpointError> {
        trained.checkpoint()?.save(self.folder.join(CHECKPOINT))
    }

    fn remove_checkpoint(&self) -> Result<(), Failure> {
        let path = self.folder.join(CHECKPOINT);
        match std::fs::remove_file(&path) {
            Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
                Err(WriteError { path, source }.into())
            }
            _ => Ok(()),
        }
    }

    /// Saves the settings (unless the scene beside them is another one) and the history of the run.
    fn save_course(&self, saving: &mut Saving, trained: &Trained, scene: bool) {
        if scene || !self.folder.join(SCENE).exists() {
            let path = self.folder.join(CONFIG);
            let written = write_durably(&path, self.config.as_bytes());
            saving.keep(
                CONFIG,
                written.map_err(|source| WriteError { path, source }),
            );
        }
        let history = &trained.history;
        saving.keep(LOSSES, write_losses(&self.folder.join(LOSSES), history));
        saving.keep(CURVES, curves(history).write(&self.folder.join(CURVES)));
    }

    /// Saves the cameras of the views.
    fn save_refined(&self, capture: &Capture, views: Vec<View>) -> Result<(), Failure> {
        let refined = with_views(capture, views);
        Ok(refined.save_model(&self.folder.join(CAMERAS))?)
    }

    /// Measures the held-out views and saves their pictures.
    fn save_views(
        &self,
        saving: &mut Saving,
        trained: &Trained,
        capture: &Capture,
        chosen: &ChosenDevice,
    ) -> Option<Scores> {
        let views: Vec<&View> = capture.test_views().collect();
        let names = picture_names(capture);
        // Views are in the given order.
        let mut stems = names.stems.iter();
        let mut pictures = Vec::new();
        let mut written = Ok(());
        let keep = |view: &View, rendered: Vec<f32>| {
            let Some(stem) = stems.next() else { return };
            let path = self.picture(stem);
            match write_view(&path, view, &rendered) {
                Ok(()) => pictures.push(path),
                Err(error) if written.is_ok() => written = Err(error),
                Err(_) => {}
            }
        };
        let scores = trained.evaluate(&views, &chosen.device, keep);
        if !views.is_empty() {
            saving.keep(VIEWS, written);
        }
        self.note_other_pictures(&pictures);
        match scores {
            Ok(scores) => Some(scores),
            Err(error) => {
                saving.keep(METRICS, Err(error));
                None
            }
        }
    }

    /// Saves the cameras that the run has refined, with the held-out views aligned with the scene,
    /// and returns their scores.
    fn save_cameras(
        &self,
        saving: &mut Saving,
        trained: &Trained,
        capture: &Capture,
        config: &TrainSettings,
        chosen: &ChosenDevice,
    ) -> Option<AlignedScores> {
        let calibration = &config.calibration;
        if !calibration.is_on() && !self.undistort {
            return None;
        }
        let measure = || -> Result<(Vec<View>, Option<AlignedScores>), Failure> {
            let mut refined = refined_views(trained, capture)?;
            if !calibration.poses || capture.split.test.is_empty() {
                return Ok((refined, None));
            }
            let views: Vec<&View> = capture.test_views().collect();
            let steps = calibration.align_steps;
            let aligned = trained.evaluate_aligned(&views, &chosen.device, steps)?;
            for (index, camera) in capture.split.test.iter().zip(&aligned.cameras) {
                refined[*index] = refined[*index].with_pose(camera);
            }
            Ok((refined, Some(aligned)))
        };
        let (views, aligned) = match measure() {
            Ok(measured) => measured,
            Err(error) => {
                saving.keep(CAMERAS, Err(error));
                return None;
            }
        };
        if calibration.is_on() {
            saving.keep(CAMERAS, self.save_refined(capture, views.clone()));
        }
        if self.undistort {
            let folder = self.folder.join(UNDISTORTED);
            let undistorted = with_views(capture, views)
                .undistorted()
                .and_then(|capture| capture.save(&folder));
            saving.keep(UNDISTORTED, undistorted);
        }
        aligned
    }

    /// Reports pictures that do not belong to this scene. They may be the user's and are kept.
    fn note_other_pictures(&self, own: &[PathBuf]) {
        let folder = self.folder.join(VIEWS);
        let Ok(entries) = std::fs::read_dir(&folder) else {
            return;
        };
        let paths = entries.filter_map(|entry| Some(entry.ok()?.path()));
        let other = |path: &PathBuf| {
            path.extension().is_some_and(|ending| ending == "png") && !own.contains(path)
        };
        let mut others: Vec<PathBuf> = paths.filter(other).collect();
        others.sort();
        if let Some(name) = others.first().and_then(|path| path.file_name()) {
            self.global.say(format_args!(
                "warning: {}: {} picture(s) were there before and are not of this scene, `{}` first",
                folder.display(),
                others.len(),
                name.display()
            ));
        }
    }

    /// An error that lists what was saved and what was not, unless everything was saved.
    fn outcome(&self, saving: Saving) -> Result<(), Failure> {
        let Some((_, reason)) = saving.failed.first() else {
            return Ok(());
        };
        let list = |names: Vec<&str>| match names.is_empty() {
            true => "nothing".to_owned(),
            false => names.join(", "),
        };
        let failed = list(saving.failed.iter().map(|(name, _)| *name).collect());
        let next = match self.folder.join(CHECKPOINT).is_file() {
            true => format!("when that is mended, go on with: {}", self.resume),
            false => "there is no checkpoint to go on from".to_owned(),
        };
        Err(Failure::BadInput(format!(
            "{reason}; in {}, not saved: {failed}; saved: {}; {next}",
            self.folder.display(),
            list(saving.saved)
        )))
    }
}

fn metrics(
    scores: &Scores,
    trained: &Trained,
    config: &TrainSettings,
    chosen: &ChosenDevice,
) -> Metrics {
    let seconds = |time: Duration| time.as_secs_f64();
    Metrics {
        scores: scores.clone(),
        gaussians: trained.model.len(),
        sh_reduction: trained.history.sh_reduction,
        steps: trained.steps,
        seconds: seconds(trained.elapsed),
        seconds_per_step: seconds(trained.elapsed) / trained.steps as f64,
        peak_rss_bytes: peak_rss_bytes(),
        device_bytes: chosen
            .device
            .memory_pool_usage()
            .map(|usage| usage.bytes_reserved),
        device: chosen.name.clone(),
        seed: config.seed,
        aligned: None,
    }
}

/// Names of the held-out views' pictures.
pub(super) fn picture_names(capture: &Capture) -> ViewNames {
    let names = capture.test_views().map(|view| view.name.as_str());
    ViewNames::new(names, &[""])
}

/// Writes photo and render side by side.
fn write_view(path: &Path, view: &View, rendered: &[f32]) -> Result<(), Failure> {
    let photo = view.loaded()?;
    let truth = Picture::from_rgb8(view.width, view.height, photo.image.to_vec())?;
    let render = Picture::from_rgb_f32(view.width, view.height, rendered)?;
    Ok(truth.beside(&render)?.write(path)?)
}

/// History of the run: the weighted sum, then each term.
fn curves(history: &History) -> Curves {
    let mut curves = Curves {
        held_out_psnr: history.held_out_psnr.clone(),
        gaussians: history.counts.clone(),
        ..Curves::default()
    };
    for record in &history.losses {
        curves.push_loss("loss", record.step, f64::from(record.total));
        for (name, &value) in history.terms.iter().zip(&record.terms) {
            curves.push_loss(name, record.step, f64::from(value));
        }
    }
    curves
}
