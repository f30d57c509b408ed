//! The runs that are missing, one after another.

use std::collections::HashSet;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

use super::csv::Table;
use super::measure::{Bench, Outcome};
use super::pictures;
use super::plan::{Plan, Run};
use crate::Failure;
use crate::command_line::CommandLine;
use splat_data::Capture;

/// The runs of a plan, to be made.
pub(super) struct Turns<'a> {
    pub plan: &'a Plan,
    pub bench: Bench<'a>,
    /// The command that goes on with what is missing.
    pub again: CommandLine,
}

/// How all ended.
#[derive(Debug, Default)]
pub(super) struct Ended {
    /// Number of runs that were measured.
    pub measured: usize,
    /// Whether Ctrl-C ended them.
    pub interrupted: bool,
    /// Runs without a result, each with the reason.
    pub failed: Vec<String>,
}

impl Turns<'_> {
    /// Makes what is missing in a table, in turns, and saves the table after every run.
    ///
    /// # Errors
    /// If a capture cannot be read, or a result cannot be saved. A run that fails is noted in
    /// [`Ended::failed`], and the others are made.
    pub(super) fn take(&self, table: &mut Table, started: Instant) -> Result<Ended, Failure> {
        let missing = self.plan.missing(&table.rows);
        let mut ended = Ended::default();
        // Photos of one capture at a time.
        let mut open: Option<(usize, Arc<Capture>)> = None;
        let mut warned = HashSet::new();
        let mut since = started;
        for (index, run) in missing.iter().enumerate() {
            if self.bench.interrupt.load(Ordering::Relaxed) {
                ended.interrupted = true;
                break;
            }
            if open.as_ref().is_none_or(|(at, _)| *at != run.capture) {
                drop(open.take());
                let capture = self.load(run, warned.insert(run.capture))?;
                open = Some((run.capture, Arc::new(capture)));
            }
            let Some((_, capture)) = &open else { continue };
            let global = self.bench.global;
            let (number, all) = (index + 1, missing.len());
            global.say(format_args!("run {number} of {all}: {run}"));
            let Run { key, .. } = run;
            let view = pictures::view_of(&table.rows, &key.capture, key.downscale);
            match self.bench.measure(run, capture, view, since)? {
                Outcome::Measured(row) => {
                    since = Instant::now();
                    global.say(format_args!(
                        "{run}: {:.2} dB, {} Gaussians, {:.1} s",
                        row.psnr, row.gaussians, row.seconds
                    ));
                    table.put(*row)?;
                    ended.measured += 1;
                }
                Outcome::Interrupted => {
                    ended.interrupted = true;
                    break;
                }
                Outcome::Failed(reason) => {
                    global.say(format_args!("failed: {reason}"));
                    ended.failed.push(reason);
                    since = Instant::now();
                }
            }
        }
        Ok(ended)
    }

    /// Reads the capture of a run, with its warnings if they were not said before.
    fn load(&self, run: &Run, warn: bool) -> Result<Capture, Failure> {
        let global = self.bench.global;
        let capture = self.plan.load(run, global)?;
        for warning in capture.warnings.iter().filter(|_| warn) {
            global.say(format_args!("warning: {warning}"));
        }
        Ok(capture)
    }

    /// Says what is done, and how to go on.
    pub(super) fn say_how_it_ended(&self, ended: &Ended, table: &Table) {
        let all = self.plan.runs().len();
        let done = self.plan.measured(&table.rows).len();
        let (global, path) = (self.bench.global, table.path());
        if ended.interrupted {
            global.say(format_args!(
                "stopped: {done} of {all} runs are measured and in {path}; to go on: {}",
                self.again
            ));
        } else if ended.measured == 0 && ended.failed.is_empty() {
            global.say(format_args!(
                "all {all} runs were measured before and are in {path}; nothing was trained"
            ));
        } else {
            global.say(format_args!(
                "{done} of {all} runs are measured and in {path}"
            ));
        }
    }
}
