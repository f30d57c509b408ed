//! Progress of long work: a bar on a terminal, periodic plain lines elsewhere, nothing if quiet.
//!
//! It is written to standard error, so that standard output contains results only.

use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

/// Interval of plain lines.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// Shows the progress of some work.
#[derive(Debug)]
pub struct Progress {
    output: Output,
    total: u64,
    /// Steps done before this run, excluded from its rate.
    start: u64,
    started: Instant,
}

#[derive(Debug)]
enum Output {
    Bar(ProgressBar),
    Lines { last: Instant },
    Quiet,
}

impl Progress {
    /// Starts showing work of `total` steps, of which `start` are already done.
    pub fn new(total: u64, start: u64, quiet: bool) -> Self {
        let output = if quiet {
            Output::Quiet
        } else if std::io::stderr().is_terminal() {
            let bar = ProgressBar::new(total).with_position(start);
            let style = "{bar:30} {pos}/{len}  {per_sec}  {msg}  {eta} left";
            // The template is fixed. If it were wrong, indicatif's default style would do.
            if let Ok(style) = ProgressStyle::with_template(style) {
                bar.set_style(style);
            }
            bar.reset_eta();
            Output::Bar(bar)
        } else {
            Output::Lines {
                last: Instant::now(),
            }
        };
        Self {
            output,
            total,
            start,
            started: Instant::now(),
        }
    }

    /// Reports `done` steps. `message` (such as the loss) is only built if it is shown.
    pub fn update(&mut self, done: u64, message: impl FnOnce() -> String) {
        match &mut self.output {
            Output::Bar(bar) => {
                bar.set_position(done);
                bar.set_message(message());
            }
            Output::Lines { last } if last.elapsed() >= LINE_EVERY || done == self.total => {
                *last = Instant::now();
                let here = done.saturating_sub(self.start);
                let line = plain_line(done, self.total, here, self.started.elapsed(), &message());
                tell(&line);
            }
            Output::Lines { .. } | Output::Quiet => {}
        }
    }

    /// Shows a separate line above the bar.
    pub fn note(&self, line: &str) {
        match &self.output {
            Output::Bar(bar) => bar.suspend(|| tell(line)),
            Output::Lines { .. } => tell(line),
            Output::Quiet => {}
        }
    }

    /// Ends the bar and leaves it visible.
    pub fn finish(&self) {
        if let Output::Bar(bar) = &self.output {
            bar.abandon();
        }
    }
}

/// `120/2000  8.31/s  loss 0.0312  226s left`, where `here` of the `done` steps took `elapsed`.
fn plain_line(done: u64, total: u64, here: u64, elapsed: Duration, message: &str) -> String {
    let rate = here as f64 / elapsed.as_secs_f64().max(1e-9);
    let mut line = format!("{done}/{total}  {rate:.2}/s  {message}");
    if rate > 0.0 && done < total {
        line += &format!("  {:.0}s left", (total - done) as f64 / rate);
    }
    line
}

/// Writes a line that is not a result. A closed pipe is not an error, and ends no run.
pub(crate) fn tell(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plain_line_has_rate_loss_and_time_left() {
        let elapsed = Duration::from_secs(50);
        assert_eq!(
            plain_line(600, 1000, 100, elapsed, "loss 0.03"),
            "600/1000  2.00/s  loss 0.03  200s left"
        );
        assert_eq!(plain_line(0, 10, 0, elapsed, ""), "0/10  0.00/s  ");
        assert_eq!(plain_line(9, 9, 9, elapsed, "x"), "9/9  0.18/s  x");
    }

    #[test]
    fn quiet_work_builds_no_message() {
        let mut progress = Progress::new(3, 0, true);
        progress.update(1, || unreachable!("nothing is shown"));
        progress.note("nothing is shown");
        progress.finish();
    }
}
