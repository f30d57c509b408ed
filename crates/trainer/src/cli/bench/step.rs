//! `splat bench step`: what a training step takes.

use std::path::PathBuf;

use clap::Args;

use super::input::CaptureArgs;
use super::{Failure, GlobalArgs, cpu_only, print, write_svg};
use crate::performance::step::measure;
use crate::report::metrics::write_json;

/// The training step on the CPU: time, stages, work; on one thread and on all
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat bench step
  splat bench step photos/ --downscale 2 --json step.json")]
pub(super) struct StepArgs {
    /// Capture: a folder with `images/` and `sparse/0/` [default: examples/data/saharov]
    capture: Option<PathBuf>,
    #[command(flatten)]
    input: CaptureArgs,
    /// Also write the figures as JSON
    #[arg(long, value_name = "OUT")]
    json: Option<PathBuf>,
    /// Also write the picture
    #[arg(long, value_name = "OUT")]
    svg: Option<PathBuf>,
}

/// Runs the command.
pub(super) fn run(args: &StepArgs, global: &GlobalArgs) -> Result<(), Failure> {
    cpu_only(global)?;
    let capture = args.input.open(args.capture.as_deref(), global)?;
    let config = args.input.config(global);
    let report = measure(&capture, &config, args.input.seconds, |line| {
        global.say(line);
    })?;
    print(&format!("{}\n{}", report.machine.line(), report.markdown()));
    if let Some(path) = &args.json {
        write_json(path, &report)?;
    }
    if let Some(path) = &args.svg {
        write_svg(path, report.svg())?;
    }
    Ok(())
}
