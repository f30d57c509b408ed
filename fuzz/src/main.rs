//! `splat-fuzz PARSER... --seconds N`: fuzzes readers for some time each; `--replay` runs single
//! inputs.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use splat_fuzz::formats::Input;
use splat_fuzz::{Campaign, Failed, Report, TARGETS, Target};

/// Fuzz the file readers
#[derive(Debug, Parser)]
struct Args {
    /// Readers: colmap_binary, colmap_text, transforms, ply, points, spz, sog, fixture, checkpoint,
    /// config, gaussians; all
    #[arg(required = true)]
    parsers: Vec<String>,
    /// Processor time for each, in seconds
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// Seed of every random draw
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Run the input in these files instead, one for each of its parts
    #[arg(long, num_args = 1..)]
    replay: Vec<PathBuf>,
}

fn main() -> ExitCode {
    let args = Args::parse();
    let mut failed = false;
    for target in chosen(&args.parsers) {
        let result = match args.replay.as_slice() {
            [] => fuzz(target, &args),
            files => replay(target, files),
        };
        match result {
            Ok(report) => println!("{}", line(target, &report)),
            Err(failure) => {
                failed = true;
                println!("FAILS: {failure}");
            }
        }
    }
    if failed {
        ExitCode::FAILURE
    } else {
        ExitCode::SUCCESS
    }
}

fn chosen(names: &[String]) -> Vec<&'static Target> {
    let all = names == ["all"];
    let known = |name: &String| TARGETS.iter().any(|target| target.name == name);
    if let Some(unknown) = names.iter().find(|name| !all && !known(name)) {
        let known: Vec<_> = TARGETS.iter().map(|target| target.name).collect();
        eprintln!(
            "error: no parser `{unknown}`; there are {}, and all",
            known.join(", ")
        );
        std::process::exit(2);
    }
    let named = |target: &&Target| all || names.iter().any(|name| name == target.name);
    TARGETS.iter().filter(named).collect()
}

fn fuzz(target: &'static Target, args: &Args) -> Result<Report, Failed> {
    let end = processor_seconds() + args.seconds;
    let mut campaign = Campaign::new(target, args.seed)?;
    while processor_seconds() < end {
        for _ in 0..100 {
            campaign.step()?;
        }
    }
    Ok(campaign.finish())
}

fn replay(target: &'static Target, files: &[PathBuf]) -> Result<Report, Failed> {
    let mut campaign = Campaign::new(target, 0)?;
    let read =
        |file: &PathBuf| std::fs::read(file).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
    campaign.execute(&Input(files.iter().map(read).collect()), true)?;
    Ok(campaign.finish())
}

fn line(target: &Target, report: &Report) -> String {
    let edges = &report.edges;
    let branches = match edges.present {
        0 => "branches not counted".to_owned(),
        present => format!(
            "{} of {present} edges in {} functions",
            edges.taken, edges.functions
        ),
    };
    format!(
        "{:<14} {:>10} runs, {:>9} let through, {:>7} handed on, {:>3} outcomes, {:>4} inputs kept, {branches}, memory {:.1} x length + {} KiB",
        target.name,
        report.executions,
        report.accepted,
        report.followed,
        report.outcomes,
        report.corpus,
        report.memory,
        target.memory.constant >> 10,
    )
}

/// Processor time used by this process, over all threads.
#[cfg(unix)]
fn processor_seconds() -> f64 {
    let mut time = libc::timespec {
        tv_sec: 0,
        tv_nsec: 0,
    };
    // SAFETY: `time` is valid for writing.
    let status = unsafe { libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &mut time) };
    assert_eq!(status, 0, "the system does not tell the process's time");
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// Wall-clock time on other systems.
#[cfg(not(unix))]
fn processor_seconds() -> f64 {
    static START: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
    let start = START.get_or_init(std::time::Instant::now);
    start.elapsed().as_secs_f64()
}
