//! `splat bench rasterize`: evaluations per second.

use std::path::{Path, PathBuf};

use burn::module::Module;
use clap::Args;

use super::input::{CaptureArgs, EXAMPLE};
use super::{Failure, GlobalArgs, chosen, print};
use crate::report::metrics::write_json;
use crate::report::probe_files;
use crate::scene;
use splat_data::View;
use splat_lab::performance::rasterize::{RasterizeReport, measure};
use splat_trainer::Trainer;

/// The rasteriser: evaluations per second, on the CPU per core, on the lists of a real scene
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat bench rasterize
  splat bench rasterize photos/ --downscale 2
  splat bench rasterize out/garden/scene.ply --capture photos/ --downscale 2
  splat bench rasterize photos/ --device wgpu

Measures the CPU unless --device names another.")]
pub(super) struct RasterizeArgs {
    /// Capture, whose initial Gaussians are rendered, or a scene.ply [default:
    /// examples/data/saharov]
    scene: Option<PathBuf>,
    /// Capture whose views are rendered, if a scene.ply is given
    #[arg(long, value_name = "DIR")]
    capture: Option<PathBuf>,
    #[command(flatten)]
    input: CaptureArgs,
    /// Also write the figures as JSON
    #[arg(long, value_name = "OUT")]
    json: Option<PathBuf>,
}

/// Runs the command.
pub(super) fn run(args: &RasterizeArgs, global: &GlobalArgs) -> Result<(), Failure> {
    let is_ply = |path: &&PathBuf| path.extension().is_some_and(|ending| ending == "ply");
    let (ply, capture) = match (&args.scene, &args.capture) {
        (Some(ply), Some(capture)) => (Some(ply), Some(capture)),
        (Some(ply), None) if is_ply(&ply) => {
            return Err(Failure::BadInput(format!(
                "{}: a scene needs --capture, the views to render it in",
                ply.display()
            )));
        }
        (Some(capture), None) | (None, Some(capture)) => (None, Some(capture)),
        (None, None) => (None, None),
    };
    probe_files([&args.json])?;
    let report = report(
        ply.map(PathBuf::as_path),
        capture.map(PathBuf::as_path),
        &args.input,
        global,
    )?;
    print(&format!("{}\n{}", report.machine.line(), report.markdown()))?;
    if let Some(path) = &args.json {
        write_json(path, &report)?;
    }
    Ok(())
}

/// Measures a scene, or the initial Gaussians of the capture, in the capture's views.
pub(super) fn report(
    ply: Option<&Path>,
    capture: Option<&Path>,
    input: &CaptureArgs,
    global: &GlobalArgs,
) -> Result<RasterizeReport, Failure> {
    let folder = capture.unwrap_or(Path::new(EXAMPLE));
    let capture = input.open(Some(folder), global)?;
    let device = chosen(global)?;
    let (gaussians, settings, name) = match ply {
        Some(ply) => {
            let exact = scene::PrecisionChoice::Exact;
            let mut data = scene::read(ply, global)?;
            data.settings.complete_from(&capture);
            let (gaussians, settings) = scene::on_device(&data, &device, exact, global);
            let name = format!("{} in the views of {}", ply.display(), capture.name);
            (gaussians, settings, name)
        }
        None => {
            let config = input.config(global);
            let trainer = Trainer::builder(capture.clone())
                .settings(config.clone())
                .device(device.clone())
                .build()?;
            let name = format!("the first Gaussians of {}", capture.name);
            let settings = config.render_settings(0, trainer.scene_scale());
            (trainer.model().valid(), settings, name)
        }
    };
    let views: Vec<&View> = capture.train_views().collect();
    let say = |line: &str| global.say(line);
    let data = gaussians.to_data();
    Ok(measure(
        &name,
        &data,
        &views,
        &settings,
        &device,
        input.seconds,
        say,
    )?)
}
