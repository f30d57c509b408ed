//! `splat gradcheck`: our gradients against those of PyTorch.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::{Failure, GlobalArgs, device, print};
use crate::gradcheck::{check_file, json, table};
use crate::report::metrics::write_json;

/// Check every gradient against fixtures written by PyTorch
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat gradcheck --device cpu --precision f64 tests/fixtures/*.safetensors
  splat gradcheck --device wgpu --json gradients.json tests/fixtures/*.safetensors")]
pub struct GradcheckArgs {
    /// Fixture files (safetensors)
    #[arg(required = true, value_name = "FILE")]
    pub files: Vec<PathBuf>,
    /// Precision to compute in
    #[arg(long, value_enum, default_value_t)]
    pub precision: Precision,
    /// Also write the figures as JSON
    #[arg(long, value_name = "OUT")]
    pub json: Option<PathBuf>,
}

/// What `--precision` takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub enum Precision {
    /// 32-bit float
    #[default]
    F32,
    /// 64-bit float, on the CPU only
    F64,
}

/// Runs the command.
pub(super) fn run(args: &GradcheckArgs, global: &GlobalArgs) -> Result<(), Failure> {
    let chosen = device::open(global)?;
    let precision = match args.precision {
        Precision::F32 => crate::gradcheck::Precision::F32,
        Precision::F64 => crate::gradcheck::Precision::F64,
    };
    let mut reports = Vec::with_capacity(args.files.len());
    for file in &args.files {
        let report = check_file(file, &chosen.device, precision)?;
        print(&table(std::slice::from_ref(&report)));
        reports.push(report);
    }
    if let Some(path) = &args.json {
        write_json(path, &json(&reports))?;
    }
    let failed = reports.iter().filter(|report| !report.pass).count();
    match failed {
        0 => Ok(()),
        _ => Err(Failure::Check(format!(
            "{failed} of {} files are outside their gates",
            reports.len()
        ))),
    }
}
