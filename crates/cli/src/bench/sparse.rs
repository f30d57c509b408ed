//! `splat bench sparse`: steps of the Gaussians that a view sees against steps of all.

use std::path::PathBuf;
use std::time::Instant;

use clap::Args;

use super::{Failure, GlobalArgs, cpu_only, in_a_process, print};
use crate::report::metrics::write_json;
use crate::report::probe_files;
use splat_lab::performance::PerformanceError;
use splat_lab::performance::scaling::PhotoSize;
use splat_lab::performance::sparse::{
    GAUSSIANS, PIXELS, Run, SHARES, Setup, SparseReport, measure_run,
};

/// Step time and memory where views see a share of the Gaussians, with and without leaving out the
/// others
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat bench sparse
  splat bench sparse --gaussians 1000000 --shares 0.05 --pixels 100000

Takes many minutes: every run is a process of its own. Measures the CPU.")]
pub(super) struct SparseArgs {
    /// Numbers of Gaussians
    #[arg(long, value_name = "N,N,...", value_delimiter = ',', default_values_t = GAUSSIANS)]
    gaussians: Vec<usize>,
    /// Shares of the Gaussians that a view sees
    #[arg(long, value_name = "S,S,...", value_delimiter = ',', default_values_t = SHARES)]
    shares: Vec<f64>,
    /// Number of pixels, or a size such as 1920x1080
    #[arg(long, default_value_t = PhotoSize::of_pixels(PIXELS))]
    pixels: PhotoSize,
    /// Also write the figures as JSON
    #[arg(long, value_name = "OUT")]
    json: Option<PathBuf>,
}

/// One run of `splat bench sparse`, as JSON
#[derive(Debug, Args)]
#[command(hide = true)]
pub(super) struct RunArgs {
    /// Number of Gaussians
    gaussians: usize,
    /// Share of the Gaussians that a view sees
    share: f64,
    /// Share below which a step leaves out the others
    sparse_share: f64,
    /// Size of the photos
    pixels: PhotoSize,
}

/// Runs the command.
pub(super) fn run(args: &SparseArgs, global: &GlobalArgs) -> Result<(), Failure> {
    cpu_only(global)?;
    let is_share = |share: &f64| *share > 0.0 && *share <= 1.0;
    if args.gaussians.contains(&0) || !args.shares.iter().all(is_share) {
        let words = "--gaussians must be at least 1, and --shares above 0 and at most 1";
        return Err(Failure::BadInput(words.to_owned()));
    }
    probe_files([&args.json])?;
    let start = Instant::now();
    let report = SparseReport::of(&args.gaussians, &args.shares, args.pixels, |setup| {
        global.say(format_args!(
            "{} Gaussians, {} seen, `sparse_share` {}, after {:.0} s",
            setup.gaussians,
            setup.share,
            setup.sparse_share,
            start.elapsed().as_secs_f64()
        ));
        child(setup)
    })?;
    print(&format!("{}\n{}", report.machine.line(), report.markdown()))?;
    if let Some(path) = &args.json {
        write_json(path, &report)?;
    }
    Ok(())
}

/// Measures a run in this process.
pub(super) fn run_one(args: &RunArgs, global: &GlobalArgs) -> Result<(), Failure> {
    cpu_only(global)?;
    let run = measure_run(&Setup {
        gaussians: args.gaussians,
        share: args.share,
        sparse_share: args.sparse_share,
        size: args.pixels,
    })?;
    print(&serde_json::to_string(&run)?)?;
    Ok(())
}

/// Runs `splat bench sparse-run`.
fn child(setup: &Setup) -> Result<Run, PerformanceError> {
    let failed = |reason: String| PerformanceError::Point {
        gaussians: setup.gaussians,
        size: setup.size,
        reason,
    };
    let arguments = [
        setup.gaussians.to_string(),
        setup.share.to_string(),
        setup.sparse_share.to_string(),
        setup.size.to_string(),
    ];
    let mut command = vec!["--quiet", "bench", "sparse-run"];
    command.extend(arguments.iter().map(String::as_str));
    in_a_process(&command).map_err(failed)
}
