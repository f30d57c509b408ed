//! The `splat` program: arguments, output, exit status. One file per command.

#[cfg(feature = "cpu")]
mod bench;
mod command_line;
mod compact;
mod convert;
mod device;
mod eval;
mod failure;
mod gradcheck;
mod info;
mod interrupt;
mod photos;
#[cfg(feature = "cpu")]
mod plots;
mod render;
mod report;
mod scene;
mod text;
mod train;

use std::io::Write;
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand};

use crate::report::progress::tell;

pub use device::DeviceChoice;
pub use failure::Failure;
pub use gradcheck::{GradcheckArgs, Precision};

/// Train, render, inspect and convert Gaussian splats.
#[derive(Debug, Parser)]
#[command(name = "splat", version, about, long_about = None)]
#[command(
    after_help = "Exit status: 0 done, 1 a check failed, 2 bad input, 130 ended by Ctrl-C with nothing saved."
)]
struct Cli {
    #[command(flatten)]
    global: GlobalArgs,
    #[command(subcommand)]
    command: Command,
}

/// Arguments of every command.
#[derive(Debug, Clone, Args)]
pub struct GlobalArgs {
    /// Where to compute; auto: a real GPU if there is one, else the CPU
    #[arg(long, global = true, value_enum, default_value_t)]
    pub device: DeviceChoice,
    /// Seed of every random draw [default: 0]
    #[arg(long, global = true)]
    pub seed: Option<u64>,
    /// Print results and errors only
    #[arg(long, global = true)]
    pub quiet: bool,
}

#[derive(Debug, Subcommand)]
enum Command {
    Train(train::TrainArgs),
    Eval(eval::EvalArgs),
    Render(render::RenderArgs),
    Info(info::InfoArgs),
    Compact(compact::CompactArgs),
    Convert(convert::ConvertArgs),
    Gradcheck(GradcheckArgs),
    #[cfg(feature = "cpu")]
    Bench(bench::BenchArgs),
}

/// Runs the program on the process's arguments.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    let global = &cli.global;
    let outcome = match &cli.command {
        Command::Train(args) => train::run(args, global),
        Command::Eval(args) => eval::run(args, global),
        Command::Render(args) => render::run(args, global),
        Command::Info(args) => info::run(args, global),
        Command::Compact(args) => compact::run(args, global),
        Command::Convert(args) => convert::run(args, global),
        Command::Gradcheck(args) => gradcheck::run(args, global),
        #[cfg(feature = "cpu")]
        Command::Bench(args) => bench::run(args, global),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            tell(&failure.to_string());
            failure.exit_code()
        }
    }
}

impl GlobalArgs {
    /// Prints a message that is not a result.
    fn say(&self, line: impl std::fmt::Display) {
        if !self.quiet {
            tell(&line.to_string());
        }
    }
}

/// Prints results. A closed pipe is not an error; any other failure to print is.
fn print(text: &str) -> Result<(), Failure> {
    let mut out = std::io::stdout().lock();
    let written = out.write_all(text.as_bytes()).and_then(|()| out.flush());
    match written {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(Failure::BadInput(
            format!("the results could not be printed: {error}"),
        )),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    #[test]
    fn the_arguments_are_consistent() {
        super::Cli::command().debug_assert();
    }
}
