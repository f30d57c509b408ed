//! `splat bench performance`: all speed benches, and their page.

use std::path::PathBuf;

use clap::Args;

use super::input::{CaptureArgs, EXAMPLE};
use super::{
    Failure, GlobalArgs, cpu_only, print, probe_report, rasterize, scaling, write, write_svg,
};
use crate::plots;
use crate::report::metrics::write_json;
use crate::report::probe_files;
use splat_lab::performance::page::PerformanceReport;
use splat_lab::performance::scaling::{GAUSSIANS, PIXELS, PhotoSize};
use splat_lab::performance::step;

/// The files of the report.
const PAGE: &str = "PERFORMANCE.md";
const STEP_SVG: &str = "performance_step.svg";
const SCALING_SVG: &str = "performance_scaling.svg";

/// All of step, rasterize and scaling, and their page PERFORMANCE.md
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat bench performance --report docs
  splat bench performance photos/ --downscale 2 --report docs")]
pub(super) struct PerformanceArgs {
    /// Capture: a folder with `images/` and `sparse/0/`, or with `transforms.json` [default:
    /// examples/data/saharov]
    capture: Option<PathBuf>,
    #[command(flatten)]
    input: CaptureArgs,
    /// Scene whose lists the rasteriser works on: a scene file [default: the capture's initial
    /// Gaussians]
    #[arg(long, value_name = "FILE")]
    scene: Option<PathBuf>,
    /// Also write the page PERFORMANCE.md and its pictures to this folder
    #[arg(long, value_name = "DIR")]
    report: Option<PathBuf>,
    /// Also write the figures as JSON
    #[arg(long, value_name = "OUT")]
    json: Option<PathBuf>,
}

/// Runs the command.
pub(super) fn run(args: &PerformanceArgs, global: &GlobalArgs) -> Result<(), Failure> {
    cpu_only(global)?;
    let folder = args.capture.as_deref();
    let capture = args.input.open(folder, global)?;
    let config = args.input.config(global);
    probe_files([&args.json])?;
    probe_report(&args.report, &[STEP_SVG, SCALING_SVG, PAGE])?;
    let say = |line: &str| global.say(line);
    let report = PerformanceReport {
        step: step::measure(&capture, &config, args.input.seconds, say)?,
        rasterize: rasterize::report(args.scene.as_deref(), folder, &args.input, global)?,
        scaling: scaling::report(&GAUSSIANS, &PIXELS.map(PhotoSize::of_pixels), global)?,
    };
    let text = page(args, &report);
    print(&text)?;
    if let Some(path) = &args.json {
        write_json(path, &report)?;
    }
    if let Some(folder) = &args.report {
        let pictures = [
            (STEP_SVG, plots::step::svg(&report.step.rows)),
            (SCALING_SVG, plots::scaling::svg(&report.scaling.points)),
        ];
        for (name, svg) in pictures {
            write_svg(&folder.join(name), svg)?;
        }
        write(folder, PAGE, &text)?;
    }
    Ok(())
}

fn page(args: &PerformanceArgs, report: &PerformanceReport) -> String {
    let typed = |name: &str, path: &Option<PathBuf>| {
        let path = path.as_ref();
        path.map_or(String::new(), |path| format!(" {name}{}", path.display()))
    };
    let downscale = args.input.typed();
    let step = typed("", &args.capture) + &downscale;
    let rasterize = match &args.scene {
        None => step.clone(),
        Some(_) => {
            let capture = args.capture.clone().or_else(|| Some(EXAMPLE.into()));
            typed("", &args.scene) + &typed("--capture ", &capture) + &downscale
        }
    };
    let all = step.clone() + &typed("--scene ", &args.scene) + &typed("--report ", &args.report);
    report.markdown([&all, &step, &rasterize])
}
