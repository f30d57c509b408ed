//! `splat bench step`: the cost of a training step.

use std::path::PathBuf;

use clap::Args;
use splat_ops::device::device_info;

use super::input::CaptureArgs;
use super::{Failure, GlobalArgs, chosen, print, write_svg};
use crate::plots;
use crate::report::metrics::write_json;
use crate::report::probe_files;
use splat_lab::performance::{device_step, step};

/// The training step: time, stages and work; on the CPU with one thread and with all, on a device
/// with launches, memory and share of memory bandwidth
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat bench step
  splat bench step photos/ --downscale 2 --json step.json
  splat bench step photos/ --downscale 2 --device wgpu

Measures the CPU unless --device names another.")]
pub(super) struct StepArgs {
    /// Capture: a folder with `images/` and `sparse/0/`, or with `transforms.json` [default:
    /// examples/data/saharov]
    capture: Option<PathBuf>,
    #[command(flatten)]
    input: CaptureArgs,
    /// Also write the figures as JSON
    #[arg(long, value_name = "OUT")]
    json: Option<PathBuf>,
    /// Also write the picture; CPU only
    #[arg(long, value_name = "OUT")]
    svg: Option<PathBuf>,
}

/// Runs the command.
pub(super) fn run(args: &StepArgs, global: &GlobalArgs) -> Result<(), Failure> {
    let device = chosen(global)?;
    let on_device = device_info(&device).is_some();
    if on_device && args.svg.is_some() {
        return Err(Failure::BadInput(
            "--svg: the picture of a step is drawn for the CPU only; leave it out, or --device"
                .to_owned(),
        ));
    }
    let capture = args.input.open(args.capture.as_deref(), global)?;
    let config = args.input.config(global);
    probe_files([&args.json, &args.svg])?;
    let (seconds, say) = (args.input.seconds, |line: &str| global.say(line));
    if on_device {
        let report = device_step::measure(&capture, &config, &device, seconds, say)?;
        print(&format!("{}\n{}", report.machine.line(), report.markdown()))?;
        if let Some(path) = &args.json {
            write_json(path, &report)?;
        }
        return Ok(());
    }
    let report = step::measure(&capture, &config, seconds, say)?;
    print(&format!("{}\n{}", report.machine.line(), report.markdown()))?;
    if let Some(path) = &args.json {
        write_json(path, &report)?;
    }
    if let Some(path) = &args.svg {
        write_svg(path, plots::step::svg(&report.rows))?;
    }
    Ok(())
}
