//! `splat bench`: errors, speed and growth, on the CPU or a CubeCL device.

mod accuracy;
mod input;
mod performance;
mod rasterize;
mod recipes;
mod scaling;
mod sparse;
mod step;

use std::path::{Path, PathBuf};

use burn::tensor::Device;
use clap::{Args, Subcommand};

use super::{DeviceChoice, Failure, GlobalArgs, device, print};
use splat_data::WriteError;

use crate::report::{probe_file, write_atomically};

/// Measure errors and speed
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat bench accuracy --report docs
  splat bench step photos/ --downscale 2
  splat bench step photos/ --downscale 2 --device wgpu
  splat bench performance --report docs
  splat bench recipes photos/ --downscale 4 --steps 7000")]
pub struct BenchArgs {
    #[command(subcommand)]
    bench: Bench,
}

/// Subcommands of `splat bench`.
#[derive(Debug, Subcommand)]
enum Bench {
    Accuracy(accuracy::AccuracyArgs),
    Step(step::StepArgs),
    Rasterize(rasterize::RasterizeArgs),
    Scaling(scaling::ScalingArgs),
    Sparse(sparse::SparseArgs),
    Capture(scaling::SyntheticArgs),
    Performance(performance::PerformanceArgs),
    Recipes(recipes::RecipesArgs),
    Point(scaling::PointArgs),
    SparseRun(sparse::RunArgs),
}

/// Runs the command.
pub(super) fn run(args: &BenchArgs, global: &GlobalArgs) -> Result<(), Failure> {
    match &args.bench {
        Bench::Accuracy(args) => accuracy::run(args, global),
        Bench::Step(args) => step::run(args, global),
        Bench::Rasterize(args) => rasterize::run(args, global),
        Bench::Scaling(args) => scaling::run(args, global),
        Bench::Sparse(args) => sparse::run(args, global),
        Bench::SparseRun(args) => sparse::run_one(args, global),
        Bench::Capture(args) => scaling::run_synthetic(args),
        Bench::Performance(args) => performance::run(args, global),
        Bench::Recipes(args) => recipes::run(args, global),
        Bench::Point(args) => scaling::run_point(args, global),
    }
}

/// Checks that the files of a report can be written, before the long work.
fn probe_report(folder: &Option<PathBuf>, names: &[&str]) -> Result<(), WriteError> {
    let Some(folder) = folder else { return Ok(()) };
    names
        .iter()
        .try_for_each(|name| probe_file(&folder.join(name)))
}

/// Writes a file of a report.
fn write(folder: &Path, name: &str, text: &str) -> Result<(), WriteError> {
    let path = folder.join(name);
    write_atomically(&path, text.as_bytes()).map_err(|source| WriteError { path, source })
}

/// Writes a picture.
fn write_svg(path: &Path, svg: Result<String, String>) -> Result<(), Failure> {
    let svg = svg.map_err(Failure::Check)?;
    let written = write_atomically(path, svg.as_bytes());
    let path = path.to_owned();
    Ok(written.map_err(|source| WriteError { path, source })?)
}

/// Device of the speed benches: the CPU, unless another is named.
fn chosen(global: &GlobalArgs) -> Result<Device, Failure> {
    match global.device {
        DeviceChoice::Auto | DeviceChoice::Cpu => Ok(Device::flex()),
        DeviceChoice::Wgpu | DeviceChoice::Vulkan | DeviceChoice::Cuda => {
            Ok(device::open(global)?.device)
        }
    }
}

/// Refuses other devices: the page of all speed benches is about the CPU.
fn cpu_only(global: &GlobalArgs) -> Result<(), Failure> {
    match global.device {
        DeviceChoice::Auto | DeviceChoice::Cpu => Ok(()),
        DeviceChoice::Wgpu | DeviceChoice::Vulkan | DeviceChoice::Cuda => Err(Failure::BadInput(
            "--device: this page is about the CPU; step, rasterize and scaling take a device each"
                .to_owned(),
        )),
    }
}

/// Runs this program with other arguments in a process of its own, and reads the JSON that it
/// prints; or says why there is none.
fn in_a_process<T: serde::de::DeserializeOwned>(arguments: &[&str]) -> Result<T, String> {
    let program = std::env::current_exe().map_err(|error| error.to_string())?;
    let output = std::process::Command::new(program).args(arguments).output();
    let output = output.map_err(|error| error.to_string())?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr);
        let words: Vec<&str> = said.split_whitespace().collect();
        // A process that runs out of memory leaves no message.
        return Err(format!("{} {}", output.status, words.join(" ")));
    }
    serde_json::from_slice(&output.stdout).map_err(|error| error.to_string())
}
