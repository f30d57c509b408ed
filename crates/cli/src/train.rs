//! `splat train`: a scene from photos.

mod results;
mod resume;

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use clap::builder::PossibleValuesParser;
use clap::{Args, ValueEnum};

use super::command_line::CommandLine;
use super::device::ChosenDevice;
use super::photos::{self, PhotoArgs};
use super::{Failure, GlobalArgs, device, eval, interrupt, print, text};
use crate::report::progress::Progress;
use crate::report::refuse_inputs;
pub(super) use results::{CAMERAS, UNDISTORTED};
use results::{CHECKPOINT, CONFIG, RunFolder, picture_names};
use resume::Interrupted;
use splat_data::{Capture, CaptureSettings};
use splat_trainer::{
    Checkpoint, RECIPES, Recipe, StrategyKind, TrainError, TrainSettings, Trainer, TrainerBuilder,
};

/// The held-out views are measured this many times during a run, for the curves.
const MEASUREMENTS: usize = 10;
/// The loss shown is the mean over this many steps.
const LOSS_WINDOW: usize = 50;
/// In shorter runs MCMC ends with holes: 18.9 dB where ADC has 20.8 (the example, quarter size,
/// 1,000 steps).
const SHORT_FOR_MCMC: usize = 5_000;
/// A crash loses no more than so many seconds of training, unless `--autosave` says otherwise.
const AUTOSAVE: u64 = 60;

/// Train a scene from photos
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat train examples/data/saharov --steps 1000
  splat train photos/ --downscale 2 --steps 7000 --out out/garden
  splat train photos/ --images images_4
  splat train photos/ --recipe compact
  splat train photos/ --resume out/garden

Writes to DIR: scene.ply, metrics.json, config.toml, curves.svg, losses.csv and views/*.png (truth
beside render); with --refine-poses or --refine-intrinsics also cameras/, a COLMAP model. Ctrl-C
finishes the step, writes the scene and a checkpoint to resume from; a second Ctrl-C ends at once.
A checkpoint is also written every minute, so that --resume goes on after a crash.

--resume takes the settings of the run from its checkpoint, and refuses another capture, another seed
and the like. --steps and --max-gaussians may be given anew: they hold from there on, schedules follow
the new number of steps, and config.toml notes it, for the run cannot be repeated from it alone then.")]
pub struct TrainArgs {
    /// Capture: a folder with `images/` and `sparse/0/`, or with `transforms.json`
    pub capture: PathBuf,
    /// Folder to write to [default: out/<name of the capture>]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Number of steps; the recipe's milestones scale with it [default: 30000]
    #[arg(long, value_name = "N")]
    pub steps: Option<usize>,
    #[command(flatten)]
    pub photos: PhotoArgs,
    /// Settings under a name, see docs/RECIPES.md [default: default]
    #[arg(long, value_parser = recipe_names(), value_name = "NAME", conflicts_with_all = ["config", "resume"])]
    pub recipe: Option<String>,
    /// Highest degree of spherical harmonics, 0 to 3 [default: 3]
    #[arg(long, value_name = "D")]
    pub sh_degree: Option<usize>,
    /// How Gaussians are added, moved and removed [default: adc]
    #[arg(long, value_enum)]
    pub strategy: Option<Strategy>,
    /// No growth beyond this many Gaussians [default: seven for every ten pixels of a photo, or one
    /// for every hundred of all photos, whichever is more]
    #[arg(long, value_name = "N")]
    pub max_gaussians: Option<usize>,
    /// Refine the poses of the training views with the scene
    #[arg(long)]
    pub refine_poses: bool,
    /// Refine focal lengths, principal points and distortion with the scene
    #[arg(long)]
    pub refine_intrinsics: bool,
    /// Also write the photos and cameras without distortion, for viewers that know pinholes only
    #[arg(long)]
    pub undistort: bool,
    /// Settings, such as the config.toml of another run; arguments win over it
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Go on with the interrupted run in this folder
    #[arg(long, value_name = "DIR", conflicts_with = "config")]
    pub resume: Option<PathBuf>,
    /// Seconds of training between checkpoints
    #[arg(long, value_name = "S", default_value_t = AUTOSAVE)]
    pub autosave: u64,
}

/// Values of `--recipe`.
pub(super) fn recipe_names() -> PossibleValuesParser {
    PossibleValuesParser::new(RECIPES.iter().map(|recipe| recipe.name))
}

/// Values of `--strategy`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Strategy {
    /// Adaptive density control of 3DGS: clone, split, prune, reset opacities
    Adc,
    /// The same, by absolute gradients (AbsGS): `density.absgrad` in config.toml
    Absgrad,
    /// Gaussians as samples (3DGS-MCMC): move dead ones, grow to a cap, add noise
    Mcmc,
    /// Improved-GS: split along the longest axis, drawn by the edges of the photos, up to a budget;
    /// with `improved.selection` in config.toml, GNS
    Improved,
}

impl Strategy {
    /// Takes the strategy instead of that of the settings, and returns what had to be dropped.
    fn choose(self, config: &mut TrainSettings) -> Option<&'static str> {
        let most = config.max_gaussians();
        config.strategy = match self {
            Self::Adc | Self::Absgrad => StrategyKind::Adc,
            Self::Mcmc => StrategyKind::Mcmc,
            Self::Improved => StrategyKind::Improved,
        };
        // A limit holds for whichever strategy is taken.
        if let (None, Some(most)) = (config.max_gaussians(), most) {
            config.set_max_gaussians(most);
        }
        let (density, absgrad) = (&mut config.density, self == Self::Absgrad);
        if config.strategy != StrategyKind::Adc || density.absgrad == absgrad {
            return None;
        }
        density.absgrad = absgrad;
        // A threshold of signed gradients is none of absolute ones, which are larger.
        (density.grow_gradient.take().is_some()).then_some(
            "`density.grow_gradient` of the settings is for the other kind of gradients; its default is taken",
        )
    }
}

impl TrainArgs {
    /// The run's settings: the file's (or the interrupted run's, or the defaults), then the
    /// arguments'.
    fn config(
        &self,
        resumed: Option<&Interrupted>,
        global: &GlobalArgs,
    ) -> Result<TrainSettings, Failure> {
        let mut config = match (resumed, &self.config) {
            (Some(run), _) => run.checkpoint.settings().clone(),
            (None, Some(path)) => text::read_config(path)?,
            (None, None) => {
                let recipe = self.recipe.as_deref().and_then(Recipe::of_name);
                recipe.map_or_else(TrainSettings::default, |recipe| recipe.settings())
            }
        };
        if let Some(note) = self
            .strategy
            .and_then(|strategy| strategy.choose(&mut config))
        {
            global.say(format_args!("note: {note}"));
        }
        config.steps = self.steps.unwrap_or(config.steps);
        config.downscale = self.photos.downscale.unwrap_or(config.downscale);
        config.seed = global.seed.unwrap_or(config.seed);
        config.init.sh_degree = self.sh_degree.unwrap_or(config.init.sh_degree);
        if let Some(most) = self.max_gaussians {
            config.set_max_gaussians(most);
        }
        config.calibration.poses |= self.refine_poses;
        config.calibration.intrinsics |= self.refine_intrinsics;
        let invalid = |problem: String| Failure::BadInput(format!("settings: {problem}"));
        config.validate().map_err(invalid)?;
        if let Some(run) = resumed {
            run.checkpoint.check_settings(&config)?;
        }
        Ok(config)
    }

    fn out(&self, resumed: Option<&Interrupted>, capture: &Capture) -> PathBuf {
        let resumed = || resumed.map(|run| run.folder().to_owned());
        let given = self.out.clone().or_else(resumed);
        given.unwrap_or_else(|| Path::new("out").join(&capture.name))
    }

    /// Adds what is read of the capture, which is no setting of the run, to a command.
    fn images(&self, line: CommandLine) -> CommandLine {
        line.photos(&PhotoArgs {
            downscale: None,
            ..self.photos.clone()
        })
    }

    /// The command that resumes the run in `out`. Its settings are in the checkpoint.
    fn resume_command(&self, out: &Path, global: &GlobalArgs) -> CommandLine {
        let line = CommandLine::new("train", global).path(&self.capture);
        let mut line = self.images(line.option("--resume", out));
        if self.undistort {
            line = line.flag("--undistort");
        }
        match self.autosave {
            AUTOSAVE => line,
            seconds => line.option("--autosave", seconds.to_string().as_ref()),
        }
    }
}

/// Runs the command.
pub(super) fn run(args: &TrainArgs, global: &GlobalArgs) -> Result<(), Failure> {
    let resumed = args.resume.as_deref().map(Interrupted::open).transpose()?;
    let config = args.config(resumed.as_ref(), global)?;
    let options = CaptureSettings {
        downscale: config.downscale,
        observations: config.calibration.poses && config.calibration.bundle_adjustment,
        ..args.photos.options()
    };
    let capture = photos::load(&args.capture, &options, global)?;
    capture.check_trainable()?;
    for warning in &capture.warnings {
        global.say(format_args!("warning: {warning}"));
    }
    if let Some(note) = picture_names(&capture).note() {
        global.say(note);
    }
    let out = args.out(resumed.as_ref(), &capture);
    resume::refuse_unfinished(&out, resumed.as_ref().map(|run| &*run.path))?;
    // Cameras of an earlier run in the folder go with its scene.
    let read = [Some(&args.capture), args.photos.cameras.as_ref()];
    let read = read.into_iter().flatten().map(PathBuf::as_path);
    refuse_inputs([out.join(CAMERAS)], read)?;
    let chosen = device::open(global)?;
    global.say(format_args!(
        "{}: {} photos to train on, {} held out, {} points",
        capture.name,
        capture.split.train.len(),
        capture.split.test.len(),
        capture.points.len()
    ));
    warn_of_settings(resumed.as_ref(), &config, global);

    // Settings that cannot be written are found before the training, not after it.
    let checkpoint = resumed.map(|run| run.checkpoint);
    let changes = checkpoint.as_ref().map(|run| run.changes_with(&config));
    let changes = changes.unwrap_or_default();
    let config_text = config_text(&out, args, global, &chosen, &config, &changes)?;
    let fresh = checkpoint.is_none();
    let capture = Arc::new(capture);
    let start = checkpoint.as_ref().map_or(0, Checkpoint::step);
    let training = || Progress::new(config.steps as u64, start as u64, global.quiet);
    let adjusts = fresh && config.calibration.poses && config.calibration.bundle_adjustment;
    let progress = Arc::new(Mutex::new(match adjusts {
        true => Progress::new(100, 0, global.quiet),
        false => training(),
    }));
    let mut trainer = Trainer::builder(capture.clone())
        .settings(config.clone())
        .device(chosen.device.clone())
        .interrupt(interrupt::flag()?)
        .evaluate_every(config.steps.div_ceil(MEASUREMENTS));
    if let Some(checkpoint) = checkpoint {
        trainer = trainer.resume(checkpoint);
    }
    let file = out.join(CHECKPOINT);
    let trainer = trainer.autosave(Duration::from_secs(args.autosave), move |checkpoint| {
        checkpoint.save(&file)
    });
    if adjusts {
        global.say(match capture.observations.is_empty() {
            true => "looking for keypoints that photos share, to adjust the poses to them",
            false => "adjusting the poses to the keypoints",
        });
    }
    let trainer = shown(trainer, &progress).build();
    let trainer = trainer.map_err(|error| match error {
        TrainError::Interrupted => Failure::Interrupted(error.to_string()),
        error => error.into(),
    })?;
    if adjusts {
        let mut progress = lock(&progress);
        progress.finish();
        *progress = training();
    }
    if let Some(warning) = trainer.warning_of_room() {
        global.say(format_args!("warning: {warning}"));
    }
    if let Some(adjusted) = trainer.bundle_adjustment() {
        global.say(format_args!(
            "{} of {} poses adjusted to {} keypoints{}: {:.2} pixels off in the median, {:.2} before",
            adjusted.views,
            adjusted.viewmats.len(),
            adjusted.keypoints,
            if adjusted.error_rematched.is_some() {
                " found in the photos"
            } else {
                ""
            },
            adjusted.error_after,
            adjusted.error_before
        ));
    }

    let resume = args.resume_command(&out, global);
    let folder = RunFolder {
        folder: &out,
        config: &config_text,
        resume: &resume,
        undistort: args.undistort,
        global,
    };
    folder.probe(&capture)?;
    if let Some(there) = folder.undistorted_before() {
        return Err(Failure::BadInput(format!(
            "{}: there already; --undistort replaces no photos, so move it or choose another --out",
            there.display()
        )));
    }
    folder.note_undistorted();
    if fresh && folder.is_taken() {
        global.say(format_args!(
            "{}: the results of an earlier run are replaced when this one ends or is interrupted",
            out.display()
        ));
    }
    let trained = trainer.run();
    lock(&progress).finish();
    let trained = trained.map_err(|error| folder.stopped(error.into()))?;

    if trained.steps < config.steps {
        folder.interrupted(&trained, &capture, &config)?;
        global.say(format_args!(
            "stopped after {} of {} steps; to go on: {resume}",
            trained.steps, config.steps
        ));
        return Ok(());
    }
    let (metrics, saved) = folder.complete(&trained, &capture, &config, &chosen);
    if let Some(metrics) = metrics.filter(|metrics| !metrics.scores.views.is_empty()) {
        print(&eval::table(&metrics.scores))?;
        if let Some(aligned) = &metrics.aligned {
            let (psnr, ssim) = (aligned.scores.psnr, aligned.scores.ssim);
            print(&format!(
                "with the poses of held-out views aligned with the scene: {psnr:.2} dB, SSIM {ssim:.4}\n"
            ))?;
        }
    }
    saved?;
    if let Some(reduced) = &trained.history.sh_reduction {
        print(&format!("spherical harmonics {reduced}\n"))?;
    }
    print(&format!(
        "{} Gaussians after {} steps in {:.1} s, in {}\n",
        trained.model.len(),
        trained.steps,
        trained.elapsed.as_secs_f64(),
        out.display()
    ))?;
    Ok(())
}

/// The bar, whatever became of another thread that had it.
fn lock(progress: &Mutex<Progress>) -> MutexGuard<'_, Progress> {
    progress.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Lets progress and warnings be seen.
fn shown(trainer: TrainerBuilder, progress: &Arc<Mutex<Progress>>) -> TrainerBuilder {
    let [shown, noted, adjusting] = [progress, progress, progress].map(Arc::clone);
    trainer
        .on_adjustment(move |share| {
            let percent = (100.0 * share) as u64;
            lock(&adjusting).update(percent, || "% of the adjustment of poses".to_owned());
        })
        .on_warning(move |warning| lock(&noted).note(&format!("warning: {warning}")))
        .on_progress(move |state| {
            lock(&shown).update(state.step as u64, || {
                let loss = state.history.mean_loss(LOSS_WINDOW);
                let loss = loss.map_or_else(String::new, |loss| format!("loss {loss:.4}  "));
                format!("{loss}{} Gaussians", state.gaussians)
            });
        })
}

/// Says what of the settings is not as one might think.
fn warn_of_settings(resumed: Option<&Interrupted>, config: &TrainSettings, global: &GlobalArgs) {
    let warn = |line: std::fmt::Arguments<'_>| global.say(format_args!("warning: {line}"));
    for section in config.unused_sections() {
        warn(format_args!(
            "[{section}] has settings of its own and no effect: it belongs to another strategy than the one chosen"
        ));
    }
    if config.strategy == StrategyKind::Mcmc && config.steps < SHORT_FOR_MCMC {
        global.say(format_args!(
            "note: mcmc begins with small Gaussians (`mcmc.init_scale`) and takes some {SHORT_FOR_MCMC} steps to fill the scene; in {} \
             steps adc gives better pictures",
            config.steps
        ));
    }
    let Some(run) = resumed else { return };
    for change in run.checkpoint.changes_with(config) {
        warn(format_args!(
            "{change}; the run cannot be repeated from its config.toml alone"
        ));
    }
    let path = run.folder().join(CONFIG);
    let beside = path.is_file().then(|| text::read_config(&path));
    let difference = match &beside {
        Some(Ok(beside)) => run.checkpoint.settings().difference_in_words(beside),
        _ => None,
    };
    if let Some(difference) = difference {
        warn(format_args!(
            "{} is not read: the settings are those of the run's checkpoint ({difference})",
            path.display()
        ));
    }
}

/// Everything needed to repeat the run, as TOML.
fn config_text(
    out: &Path,
    args: &TrainArgs,
    global: &GlobalArgs,
    chosen: &ChosenDevice,
    config: &TrainSettings,
    changes: &[String],
) -> Result<String, Failure> {
    let repeat = args.images(CommandLine::new("train", global).path(&args.capture));
    let repeat = repeat
        .option("--config", &out.join(CONFIG))
        .option("--out", out);
    // A path with a line break would go on outside of the comment.
    let repeat = repeat
        .in_a_line()
        .unwrap_or("splat train --config with this file");
    let changes: String = changes
        .iter()
        .map(|change| format!("# not of the whole run: {change}\n"))
        .collect();
    Ok(format!(
        "# splat {} on {}; to repeat: {repeat}\n{changes}{}",
        env!("CARGO_PKG_VERSION"),
        chosen.name,
        toml::to_string(config)?
    ))
}
