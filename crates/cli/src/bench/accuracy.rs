//! `splat bench accuracy`: error and speed.

use std::path::PathBuf;

use clap::Args;

use super::{DeviceChoice, Failure, GlobalArgs, device, print, probe_report, write};
use crate::plots;
use crate::report::metrics::write_json;
use crate::report::probe_files;
use splat_lab::accuracy::report::{Backend, Report};

/// The 44 hard cases: error of image and gradients, and time
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat bench accuracy
  splat bench accuracy --device cpu --json accuracy.json
  splat bench accuracy --report docs

Without --device every backend of this machine is measured: the CPU, and what wgpu finds.
Exit status: 0 every demand holds, 1 one does not, 2 bad input.")]
pub struct AccuracyArgs {
    /// Also write the figures as JSON
    #[arg(long, value_name = "OUT")]
    pub json: Option<PathBuf>,
    /// Also write the page ACCURACY.md and its picture accuracy.svg to this folder
    #[arg(long, value_name = "DIR")]
    pub report: Option<PathBuf>,
}

/// Runs the command.
pub(super) fn run(args: &AccuracyArgs, global: &GlobalArgs) -> Result<(), Failure> {
    let backends = backends(global)?;
    probe_files([&args.json])?;
    probe_report(&args.report, &["accuracy.svg", "ACCURACY.md"])?;
    let report = Report::measure(&backends, |backend, case| {
        global.say(format_args!(
            "case {:>2} on {}: {}",
            case.number, backend.name, case.name
        ));
    })?;
    print(&report.markdown())?;
    if let Some(path) = &args.json {
        write_json(path, &report)?;
    }
    if let Some(folder) = &args.report {
        write(
            folder,
            "accuracy.svg",
            &plots::accuracy::svg(&report).map_err(Failure::Check)?,
        )?;
        write(folder, "ACCURACY.md", &page(&report, &backends))?;
    }
    let failed = report.failures().count();
    if failed > 0 {
        return Err(Failure::Check(format!(
            "{failed} demand(s) of the hard cases do not hold"
        )));
    }
    Ok(())
}

/// The chosen device, or all available ones.
fn backends(global: &GlobalArgs) -> Result<Vec<Backend>, Failure> {
    let one = |choice: DeviceChoice| -> Result<Backend, Failure> {
        let chosen = device::open(&GlobalArgs {
            device: choice,
            ..global.clone()
        })?;
        let short = chosen.name.split(' ').next().unwrap_or_default();
        Ok(Backend {
            name: short.to_owned(),
            description: chosen.name.clone(),
            device: chosen.device,
        })
    };
    match global.device {
        DeviceChoice::Auto => {
            let mut all = vec![one(DeviceChoice::Cpu)?];
            all.extend(one(DeviceChoice::Wgpu).ok());
            Ok(all)
        }
        chosen => Ok(vec![one(chosen)?]),
    }
}

/// `docs/ACCURACY.md`.
fn page(report: &Report, backends: &[Backend]) -> String {
    let names: Vec<&str> = backends
        .iter()
        .map(|backend| backend.description.as_str())
        .collect();
    format!(
        "# Accuracy\n\n\
         Written by `cargo run --release -- bench accuracy --report docs`.\n\n\
         Machine: {}. Backends: {}. Double precision on the CPU is the reference; it is itself held to PyTorch float64 \
         within a relative L2 error of 1e-9 on every fixture (`cargo test --release --test gradients`).\n\n\
         Everything is measured in full single precision, which training always uses; the exponential is a polynomial of \
         degree 5 (relative error below 2e-7, fused or not). Two cheaper variants were measured and dropped. \
         A polynomial of degree 3 (1e-4) made forward and backward together 0 to 2 % faster on 50,000 splats, and between \
         6 % faster and 3 % slower on 15,000. SH coefficients in half precision (f16, converted eight at a time by the \
         processor, sums in f32) have an error of 2.1e-4 on the CPU and are slower: the colours of 1,000,000 splats at \
         degree 3 took 31 ms instead of 19, those of 100,000 at least 2.8 ms instead of 1.4. CubeCL devices can render \
         from such coefficients (`--sh-precision half`): a test holds the colours of random ones within a relative L2 \
         error of 1e-4 of double precision, and `docs/notes/half-precision.md` has the error on a trained scene and the \
         bytes saved.\n\n\
         ![error against time](accuracy.svg)\n\n{}",
        report.machine,
        names.join(", "),
        report.markdown()
    )
}
