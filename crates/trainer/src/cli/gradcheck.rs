//! `splat gradcheck`: arguments. The command joins the others when its judge does.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

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
