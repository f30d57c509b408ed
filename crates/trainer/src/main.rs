//! The `splat` program; see `splat --help`.

use std::process::ExitCode;

fn main() -> ExitCode {
    splat_trainer::cli::main()
}
