//! `splat gradcheck`: every gradient, compared with fixtures.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::{Failure, GlobalArgs, device, print};
use crate::report::metrics::write_json;
use crate::report::{probe_files, refuse_inputs};
use splat_lab::gradcheck::{self, Bug, check_file};

/// Check every gradient against fixtures written by PyTorch
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat gradcheck --device cpu --precision f64 tests/fixtures/*.safetensors
  splat gradcheck --device wgpu --json gradients.json tests/fixtures/*.safetensors
  splat gradcheck --perturb clamp-ignored tests/fixtures/clamped_*.safetensors

Exit status: 0 every gradient holds, 1 one does not, 2 bad input.")]
pub struct GradcheckArgs {
    /// Fixture files (safetensors)
    #[arg(required = true, value_name = "FILE")]
    pub files: Vec<PathBuf>,
    /// Precision to compute in
    #[arg(long, value_enum, default_value_t)]
    pub precision: Precision,
    /// Switch on a known bug, to see the check fail
    #[arg(long, value_enum, value_name = "BUG")]
    pub perturb: Option<Perturb>,
    /// Also write the figures as JSON
    #[arg(long, value_name = "OUT")]
    pub json: Option<PathBuf>,
}

/// Values of `--precision`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub enum Precision {
    /// 32-bit float
    #[default]
    F32,
    /// 64-bit float, on the CPU only
    F64,
}

impl From<Precision> for gradcheck::Precision {
    fn from(precision: Precision) -> Self {
        match precision {
            Precision::F32 => Self::F32,
            Precision::F64 => Self::F64,
        }
    }
}

/// Values of `--perturb`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Perturb {
    /// The direction of the spherical harmonics passes no gradient on
    DirectionDetached,
    /// The backward of the projection forgets that the quaternion is normalised
    QuaternionNormalisationSkipped,
    /// Half of the gradient through the off-diagonal of the inverse covariance is lost
    OffDiagonalHalved,
    /// The Jacobian of the projection is not clamped off-screen
    ClampIgnored,
}

impl From<Perturb> for Bug {
    fn from(perturb: Perturb) -> Self {
        match perturb {
            Perturb::DirectionDetached => Self::DirectionDetached,
            Perturb::QuaternionNormalisationSkipped => Self::QuaternionNormalisationSkipped,
            Perturb::OffDiagonalHalved => Self::OffDiagonalHalved,
            Perturb::ClampIgnored => Self::ClampIgnored,
        }
    }
}

/// Runs the command.
pub(super) fn run(args: &GradcheckArgs, global: &GlobalArgs) -> Result<(), Failure> {
    let device = device::open(global)?.device;
    let precision = args.precision.into();
    let bug = args.perturb.map(Bug::from);
    if let Some(bug) = bug {
        global.say(format_args!("with a known bug switched on: {bug:?}"));
    }
    probe_files([&args.json])?;
    refuse_inputs(args.json.clone(), args.files.iter().map(PathBuf::as_path))?;
    let reports = args
        .files
        .iter()
        .map(|path| check_file(path, &device, precision, bug))
        .collect::<Result<Vec<_>, _>>()?;
    print(&gradcheck::table(&reports))?;
    if let Some(path) = &args.json {
        write_json(path, &gradcheck::json(&reports))?;
    }
    let failed = reports.iter().filter(|report| !report.pass).count();
    if failed > 0 {
        return Err(Failure::Check(format!(
            "{failed} of {} fixture(s) do not agree",
            reports.len()
        )));
    }
    Ok(())
}
