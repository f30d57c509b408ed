//! `splat train`: a scene from photos.

use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use clap::{Args, ValueEnum};
use splat_model::files::ply;

use super::device::ChosenDevice;
use super::photos::PhotoArgs;
use super::{Failure, GlobalArgs, device, eval, interrupt, print, scene};
use crate::capture::{Capture, CaptureOptions, View};
use crate::report::curves::Curves;
use crate::report::losses::write_losses;
use crate::report::memory::peak_rss_bytes;
use crate::report::metrics::{Metrics, write_json};
use crate::report::png::Picture;
use crate::report::progress::Progress;
use crate::report::view_names::ViewNames;
use crate::report::{ReportError, write_atomically};
use crate::train::{Checkpoint, CheckpointError, History, TrainConfig, Trained, Trainer};
use crate::{Scores, evaluate};

/// The held-out views are measured this many times during a run, for the curves.
const MEASUREMENTS: usize = 10;
/// The loss shown is the mean over this many steps.
const LOSS_WINDOW: usize = 50;
/// Name of the checkpoint in a run's folder.
const CHECKPOINT: &str = "checkpoint.safetensors";
/// A crash loses no more than this much training.
const AUTOSAVE: Duration = Duration::from_secs(60);

/// Train a scene from photos
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat train examples/data/saharov --steps 1000
  splat train photos/ --downscale 2 --steps 7000 --out out/garden
  splat train photos/ --images images_4
  splat train photos/ --resume out/garden

Writes to DIR: scene.ply, metrics.json, config.toml, curves.svg, losses.csv and views/*.png (truth
beside render). Ctrl-C finishes the step and writes a checkpoint to resume from; a second Ctrl-C ends
at once. A checkpoint is also written every minute, so that --resume goes on after a crash.")]
pub struct TrainArgs {
    /// Capture: a folder with `images/` and `sparse/0/`
    pub capture: PathBuf,
    /// Folder to write to [default: out/<name of the capture>]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Number of steps; the recipe's milestones scale with it [default: 30000]
    #[arg(long, value_name = "N")]
    pub steps: Option<usize>,
    #[command(flatten)]
    pub photos: PhotoArgs,
    /// Highest degree of spherical harmonics, 0 to 3 [default: 3]
    #[arg(long, value_name = "D")]
    pub sh_degree: Option<usize>,
    /// Density control
    #[arg(long, value_enum, default_value_t)]
    pub strategy: Strategy,
    /// No growth beyond this many Gaussians [default: seven for every ten pixels of a photo, or one for every hundred
    /// of all photos, whichever is more]
    #[arg(long, value_name = "N")]
    pub max_gaussians: Option<usize>,
    /// Settings, such as the config.toml of another run; arguments win over it
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Go on with the interrupted run in this folder
    #[arg(long, value_name = "DIR", conflicts_with = "config")]
    pub resume: Option<PathBuf>,
}

/// What `--strategy` takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub enum Strategy {
    /// Adaptive density control of 3DGS: clone, split, prune, reset opacities
    #[default]
    Adc,
}

impl TrainArgs {
    /// The run's settings: the file's (or the interrupted run's, or the defaults), then the arguments'.
    fn config(&self, global: &GlobalArgs) -> Result<TrainConfig, Failure> {
        let resumed = self
            .resume
            .as_ref()
            .map(|folder| folder.join("config.toml"));
        let mut config = match resumed.or_else(|| self.config.clone()) {
            Some(path) => scene::read_config(&path)?,
            None => TrainConfig::default(),
        };
        let Strategy::Adc = self.strategy;
        config.steps = self.steps.unwrap_or(config.steps);
        config.downscale = self.photos.downscale.unwrap_or(config.downscale);
        config.seed = global.seed.unwrap_or(config.seed);
        config.init.sh_degree = self.sh_degree.unwrap_or(config.init.sh_degree);
        config.density.max_gaussians = self.max_gaussians.or(config.density.max_gaussians);
        match config.problem() {
            None => Ok(config),
            Some(problem) => Err(Failure::BadInput(format!("settings: {problem}"))),
        }
    }

    fn out(&self, capture: &Capture) -> PathBuf {
        let given = self.out.clone().or_else(|| self.resume.clone());
        given.unwrap_or_else(|| Path::new("out").join(&capture.name))
    }
}

/// Runs the command.
pub(super) fn run(args: &TrainArgs, global: &GlobalArgs) -> Result<(), Failure> {
    let config = args.config(global)?;
    let checkpoint = match &args.resume {
        Some(folder) => Some(Checkpoint::load(&folder.join(CHECKPOINT))?),
        None => None,
    };
    let options = CaptureOptions {
        downscale: config.downscale,
        ..args.photos.options()
    };
    let capture = Capture::load(&args.capture, &options)?;
    capture.check_trainable()?;
    for warning in &capture.warnings {
        global.say(format_args!("warning: {warning}"));
    }
    if let Some(note) = picture_names(&capture).note() {
        global.say(note);
    }
    let out = args.out(&capture);
    let chosen = device::open(global)?;
    global.say(format_args!(
        "{}: {} photos to train on, {} held out, {} points",
        capture.name,
        capture.split.train.len(),
        capture.split.test.len(),
        capture.points.len()
    ));

    // What cannot be written down should be known before the training, not after it.
    let config_path = out.join("config.toml");
    let config_text = config_text(&config_path, args, &chosen, &config)?;

    let checkpoint_path = out.join(CHECKPOINT);
    let save = {
        let (path, config_path, text) = (
            checkpoint_path.clone(),
            config_path.clone(),
            config_text.clone(),
        );
        move |checkpoint: &Checkpoint| {
            // The settings first: a checkpoint is of no use without them.
            write_atomically(&config_path, text.as_bytes()).map_err(|source| {
                CheckpointError::Io {
                    path: config_path.clone(),
                    source,
                }
            })?;
            checkpoint.save(&path)
        }
    };

    let done = checkpoint.as_ref().map_or(0, Checkpoint::step);
    let progress = Progress::new(config.steps as u64, done as u64, global.quiet);
    let progress = Rc::new(RefCell::new(progress));
    let [shown, noted] = [&progress, &progress].map(Rc::clone);
    let capture = Arc::new(capture);
    let mut trainer = Trainer::builder()
        .capture(capture.clone())
        .config(config.clone())
        .device(chosen.device.clone())
        .interrupt(interrupt::flag()?)
        .evaluate_every(config.steps.div_ceil(MEASUREMENTS))
        .autosave(AUTOSAVE, save.clone())
        .on_warning(move |warning| noted.borrow().note(&format!("warning: {warning}")))
        .on_progress(move |state| {
            shown.borrow_mut().update(state.step as u64, || {
                let loss = state.history.mean_loss(LOSS_WINDOW);
                let loss = loss.map_or_else(String::new, |loss| format!("loss {loss:.4}  "));
                format!("{loss}{} Gaussians", state.gaussians)
            });
        });
    if let Some(checkpoint) = checkpoint {
        trainer = trainer.resume(checkpoint);
    }
    let trained = trainer.build()?.run();
    progress.borrow().finish();
    let trained = trained?;

    // Before the rest, so that nothing is lost should the rest fail.
    save(&trained.checkpoint)?;
    if trained.steps < config.steps {
        global.say(format_args!(
            "stopped after {} of {} steps; to go on: splat train {} --resume {}",
            trained.steps,
            config.steps,
            args.capture.display(),
            out.display()
        ));
        return Ok(());
    }
    let scores = finish(&out, &capture, &config, &chosen, &trained)?;
    std::fs::remove_file(&checkpoint_path).map_err(|source| ReportError::Io {
        path: checkpoint_path,
        source,
    })?;
    if !scores.views.is_empty() {
        print(&eval::table(&scores));
    }
    print(&format!(
        "{} Gaussians after {} steps in {:.1} s, in {}\n",
        trained.gaussians.len(),
        trained.steps,
        trained.elapsed.as_secs_f64(),
        out.display()
    ));
    Ok(())
}

/// Everything needed to repeat the run, as TOML.
fn config_text(
    path: &Path,
    args: &TrainArgs,
    chosen: &ChosenDevice,
    config: &TrainConfig,
) -> Result<String, Failure> {
    Ok(format!(
        "# splat {} on {}; to repeat: splat train {} --config {}\n{}",
        env!("CARGO_PKG_VERSION"),
        chosen.name,
        args.capture.display(),
        path.display(),
        toml::to_string(config)?
    ))
}

/// Writes the scene, its pictures, curves and figures.
fn finish(
    out: &Path,
    capture: &Capture,
    config: &TrainConfig,
    chosen: &ChosenDevice,
    trained: &Trained,
) -> Result<Scores, Failure> {
    ply::write(&out.join("scene.ply"), &trained.gaussians.to_data())?;
    curves(&trained.history).write(&out.join("curves.svg"))?;
    write_losses(&out.join("losses.csv"), &trained.history)?;

    let views: Vec<&View> = capture.test_views().collect();
    let names = picture_names(capture);
    let mut stems = names.stems.iter();
    let mut written = Ok(());
    let keep = |view: &View, rendered: Vec<f32>| {
        // Views come in the order given.
        if let (Ok(()), Some(stem)) = (&written, stems.next()) {
            written = write_view(&out.join("views"), stem, view, &rendered);
        }
    };
    let scores = evaluate(
        &trained.gaussians,
        &views,
        &trained.render_settings,
        &chosen.device,
        keep,
    )?;
    written?;

    let seconds = |time: Duration| time.as_secs_f64();
    let metrics = Metrics {
        scores: scores.clone(),
        gaussians: trained.gaussians.len(),
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
    };
    write_json(&out.join("metrics.json"), &metrics)?;
    Ok(scores)
}

/// The names of the held-out views' pictures.
fn picture_names(capture: &Capture) -> ViewNames {
    let names = capture.test_views().map(|view| view.name.as_str());
    ViewNames::new(names, &[""])
}

/// Truth beside render.
fn write_view(folder: &Path, stem: &str, view: &View, rendered: &[f32]) -> Result<(), ReportError> {
    let truth = Picture::from_rgb8(view.width, view.height, view.image.to_vec())?;
    let render = Picture::from_rgb_f32(view.width, view.height, rendered)?;
    let path = folder.join(format!("{stem}.png"));
    truth.beside(&render)?.write(&path)
}

/// The course of the run: the weighted sum, then each term.
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
