//! `splat eval`: scores of a scene on a capture's views.

use std::fmt::Write;
use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::photos::PhotoArgs;
use super::{Failure, GlobalArgs, device, print, scene};
use crate::report::metrics::write_json;
use crate::report::{probe_files, refuse_inputs};
use splat_data::View;
use splat_trainer::{Scores, evaluate};

/// Measure PSNR and SSIM of a scene on a capture's held-out views
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat eval examples/data/saharov out/saharov/scene.ply
  splat eval photos/ scene.ply --split all --json scores.json
  splat eval photos/ scene.ply --images images_4
  splat eval photos/ out/photos/scene.ply --cameras out/photos/cameras")]
pub struct EvalArgs {
    /// Capture: a folder with `images/` and `sparse/0/`, or with `transforms.json`
    pub capture: PathBuf,
    /// Scene: a PLY file in the 3DGS layout, SPZ or SOG
    pub scene: PathBuf,
    /// Precision of the higher degrees of spherical harmonics
    #[arg(long, value_enum, default_value_t)]
    pub sh_precision: scene::PrecisionChoice,
    /// Views to measure
    #[arg(long, value_enum, default_value_t)]
    pub split: SplitChoice,
    #[command(flatten)]
    pub photos: PhotoArgs,
    /// Also write the figures as JSON
    #[arg(long, value_name = "OUT")]
    pub json: Option<PathBuf>,
}

/// Values of `--split`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub enum SplitChoice {
    /// Held-out views
    #[default]
    Test,
    /// Views that were trained on
    Train,
    /// Every view
    All,
}

/// Runs the command.
pub(super) fn run(args: &EvalArgs, global: &GlobalArgs) -> Result<(), Failure> {
    let capture = args.photos.open(&args.capture, global)?;
    let views: Vec<&View> = match args.split {
        SplitChoice::Test => capture.test_views().collect(),
        SplitChoice::Train => capture.train_views().collect(),
        SplitChoice::All => capture.views.iter().collect(),
    };
    if views.is_empty() {
        return Err(Failure::BadInput(format!(
            "{}: no view in this split; choose another with --split",
            args.capture.display()
        )));
    }
    let device = device::open(global)?.device;
    let mut data = scene::read(&args.scene, global)?;
    data.settings.complete_from(&capture);
    let (gaussians, settings) = scene::on_device(&data, &device, args.sh_precision, global);
    args.photos
        .warn_of_refined(&args.capture, &args.scene, global);
    probe_files([&args.json])?;
    refuse_inputs(args.json.clone(), [args.scene.as_path()])?;
    let scores = evaluate(&gaussians, &views, &settings, &device, |_, _| {})?;
    print(&table(&scores))?;
    if let Some(path) = &args.json {
        write_json(path, &scores)?;
    }
    Ok(())
}

/// The scores as text, one view per line, the means last.
pub(super) fn table(scores: &Scores) -> String {
    let names = scores.views.iter().map(|view| view.name.chars().count());
    let width = names.max().unwrap_or(0).max(4);
    let mut text = format!("{:width$}  PSNR dB    SSIM\n", "view");
    for view in &scores.views {
        let _ = writeln!(
            text,
            "{:width$}  {:7.3}  {:.4}",
            view.name, view.psnr, view.ssim
        );
    }
    let _ = writeln!(
        text,
        "{:width$}  {:7.3}  {:.4}",
        "mean", scores.psnr, scores.ssim
    );
    text
}
