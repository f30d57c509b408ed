//! `splat bench scaling`: growth of time and memory.

use std::path::PathBuf;
use std::time::Instant;

use clap::Args;

use super::{DeviceChoice, Failure, GlobalArgs, chosen, in_a_process, print, write_svg};
use crate::plots;
use crate::report::metrics::write_json;
use crate::report::{probe_files, probe_folder};
use splat_lab::performance::PerformanceError;
use splat_lab::performance::scaling::{
    GAUSSIANS, PIXELS, PhotoSize, Point, ScalingReport, measure_point, synthetic_capture,
};

/// Step time and memory against Gaussians and pixels, on a synthetic scene
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat bench scaling
  splat bench scaling --gaussians 10000,100000 --pixels 500000 --svg scaling.svg
  splat bench scaling --gaussians 1000000 --pixels 1920x1080 --device wgpu

Takes some minutes: every point is measured in a process of its own. Measures the CPU unless --device names another.")]
pub(super) struct ScalingArgs {
    /// Numbers of Gaussians
    #[arg(long, value_name = "N,N,...", value_delimiter = ',', default_values_t = GAUSSIANS)]
    gaussians: Vec<usize>,
    /// Numbers of pixels, or sizes such as 1920x1080
    #[arg(long, value_name = "P,P,...", value_delimiter = ',', default_values_t = PIXELS.map(PhotoSize::of_pixels))]
    pixels: Vec<PhotoSize>,
    /// Also write the figures as JSON
    #[arg(long, value_name = "OUT")]
    json: Option<PathBuf>,
    /// Also write the picture
    #[arg(long, value_name = "OUT")]
    svg: Option<PathBuf>,
}

/// One point of `splat bench scaling`, as JSON
#[derive(Debug, Args)]
#[command(hide = true)]
pub(super) struct PointArgs {
    /// Number of Gaussians
    gaussians: usize,
    /// Size of the photos
    pixels: PhotoSize,
}

/// Write the synthetic capture of `splat bench scaling`, for other programs to measure
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat bench capture 1000000 1920x1080 --out out/synthetic
  splat bench rasterize out/synthetic --device wgpu")]
pub(super) struct SyntheticArgs {
    /// Number of Gaussians
    gaussians: usize,
    /// Number of pixels, or a size such as 1920x1080
    pixels: PhotoSize,
    /// Folder of the capture
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// Writes a synthetic capture.
pub(super) fn run_synthetic(args: &SyntheticArgs) -> Result<(), Failure> {
    check_gaussians("GAUSSIANS", &[args.gaussians])?;
    // Checked first, since rendering the photos takes long.
    let model = args.out.join("sparse");
    if model.exists() {
        return Err(Failure::BadInput(format!(
            "{}: there is a capture already; choose another folder",
            model.display()
        )));
    }
    probe_folder(&args.out)?;
    synthetic_capture(args.gaussians, args.pixels).save(&args.out)?;
    print(&format!("{}\n", args.out.display()))?;
    Ok(())
}

fn check_gaussians(name: &str, gaussians: &[usize]) -> Result<(), Failure> {
    match gaussians.contains(&0) {
        true => Err(Failure::BadInput(format!("{name} must be at least 1"))),
        false => Ok(()),
    }
}

/// Runs the command.
pub(super) fn run(args: &ScalingArgs, global: &GlobalArgs) -> Result<(), Failure> {
    check_gaussians("--gaussians", &args.gaussians)?;
    probe_files([&args.json, &args.svg])?;
    let report = report(&args.gaussians, &args.pixels, global)?;
    print(&format!("{}\n{}", report.machine.line(), report.markdown()))?;
    if let Some(path) = &args.json {
        write_json(path, &report)?;
    }
    if let Some(path) = &args.svg {
        write_svg(path, plots::scaling::svg(&report.points))?;
    }
    Ok(())
}

/// Measures a point in this process.
pub(super) fn run_point(args: &PointArgs, global: &GlobalArgs) -> Result<(), Failure> {
    let point = measure_point(args.gaussians, args.pixels, &chosen(global)?)?;
    print(&serde_json::to_string(&point)?)?;
    Ok(())
}

/// Measures all points, each in its own process.
pub(super) fn report(
    gaussians: &[usize],
    sizes: &[PhotoSize],
    global: &GlobalArgs,
) -> Result<ScalingReport, Failure> {
    let device = chosen(global)?;
    let mut done = 0;
    let start = Instant::now();
    let measured = ScalingReport::of(gaussians, sizes, &device, |gaussians, size| {
        done += 1;
        global.say(format_args!(
            "point {done}, {gaussians} Gaussians and {size} pixels, after {:.0} s",
            start.elapsed().as_secs_f64()
        ));
        child(gaussians, size, global.device)
    });
    Ok(measured?)
}

/// Runs `splat bench point`.
fn child(
    gaussians: usize,
    size: PhotoSize,
    device: DeviceChoice,
) -> Result<Point, PerformanceError> {
    let failed = |reason: String| PerformanceError::Point {
        gaussians,
        size,
        reason,
    };
    let (gaussians, size) = (gaussians.to_string(), size.to_string());
    let device = ["--device", device.argument()];
    let point = ["--quiet", "bench", "point", &gaussians, &size];
    in_a_process(&[&device[..], &point].concat()).map_err(failed)
}
