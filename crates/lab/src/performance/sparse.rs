//! Steps of the Gaussians that a view sees against steps of all: `splat bench sparse`.
//!
//! Every run is a process of its own, so that peak memory is its own, and runs of both kinds take
//! turns, so that other load on the machine affects them alike.

use std::fmt::Write;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::scaling::{PhotoSize, partly_seen_capture};
use super::step::{at_degree, run};
use super::{Machine, PerformanceError, Spread, all_threads, on_threads};
use crate::memory::peak_rss_bytes;
use splat_trainer::TrainSettings;

/// Numbers of Gaussians.
pub const GAUSSIANS: [usize; 3] = [100_000, 1_000_000, 3_000_000];
/// Shares of them that a view sees.
pub const SHARES: [f64; 3] = [1.0, 0.2, 0.05];
/// Pixels of a photo.
pub const PIXELS: usize = 500_000;
/// Unmeasured steps: degree 3 is reached, and each of the four views has been seen twice.
const WARM_UP: usize = 8;
/// Measured steps of a run, each view as often as every other.
const STEPS: usize = 8;
/// [`TrainSettings::sparse_share`] of the steps of those that a view sees.
const SPARSE_SHARE: f64 = 0.5;
/// Runs of each kind.
const ROUNDS: usize = 3;

/// A scene and how it is trained.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Setup {
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Share of them that a view sees.
    pub share: f64,
    /// [`TrainSettings::sparse_share`].
    pub sparse_share: f64,
    /// Size of the photos.
    pub size: PhotoSize,
}

/// One run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// Milliseconds of each step.
    pub milliseconds: Vec<f64>,
    /// Median time of each stage, in the order of completion.
    pub stages: Vec<(String, f64)>,
    /// Peak resident memory of the process.
    pub peak_rss_bytes: Option<u64>,
    /// Threads.
    pub threads: usize,
}

/// All runs of one kind.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Kind {
    /// Time of a step.
    pub milliseconds: Spread,
    /// Median times of the stages, of the last run.
    pub stages: Vec<(String, f64)>,
    /// Peak resident memory, the most of all runs.
    pub peak_rss_bytes: Option<u64>,
}

/// A scene, trained both ways.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Share of them that a view sees.
    pub share: f64,
    /// Steps of all.
    pub all: Kind,
    /// Steps of those that a view sees.
    pub seen: Kind,
}

/// All scenes.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SparseReport {
    /// Machine and date.
    pub machine: Machine,
    /// Threads.
    pub threads: usize,
    /// Pixels of a photo.
    pub pixels: usize,
    /// Scenes in the order of measurement.
    pub rows: Vec<Row>,
}

/// Measures one run in this process, on the CPU.
///
/// # Errors
/// When a step fails.
pub fn measure_run(setup: &Setup) -> Result<Run, PerformanceError> {
    let Setup {
        gaussians,
        share,
        sparse_share,
        size,
    } = *setup;
    let capture = Arc::new(partly_seen_capture(gaussians, size, share));
    let settings = TrainSettings::default().with_sparse_share(sparse_share);
    let config = at_degree(&settings, 3);
    let threads = all_threads().into_iter().max().unwrap_or(1);
    let samples = on_threads(threads, || run(&capture, &config, WARM_UP, STEPS))?;
    let steps = samples.steps.iter();
    Ok(Run {
        milliseconds: steps.map(|(seconds, _)| 1e3 * seconds).collect(),
        stages: samples.stages(),
        peak_rss_bytes: peak_rss_bytes(),
        threads,
    })
}

impl Kind {
    fn of(runs: &[Run]) -> Self {
        let steps = runs.iter().flat_map(|run| run.milliseconds.iter().copied());
        Self {
            milliseconds: Spread::of(steps.collect()),
            stages: runs.last().map_or_else(Vec::new, |run| run.stages.clone()),
            peak_rss_bytes: runs.iter().filter_map(|run| run.peak_rss_bytes).max(),
        }
    }
}

impl SparseReport {
    /// Measures all scenes, each run by `measure`.
    ///
    /// # Errors
    /// The error of the first run that fails.
    pub fn of(
        gaussians: &[usize],
        shares: &[f64],
        size: PhotoSize,
        mut measure: impl FnMut(&Setup) -> Result<Run, PerformanceError>,
    ) -> Result<Self, PerformanceError> {
        let mut report = Self {
            machine: Machine::here(),
            threads: 1,
            pixels: size.pixels(),
            rows: vec![],
        };
        for gaussians in gaussians {
            for share in shares {
                let mut runs: [Vec<Run>; 2] = Default::default();
                for _ in 0..ROUNDS {
                    for (runs, sparse_share) in runs.iter_mut().zip([0.0, SPARSE_SHARE]) {
                        let run = measure(&Setup {
                            gaussians: *gaussians,
                            share: *share,
                            sparse_share,
                            size,
                        })?;
                        report.threads = run.threads;
                        runs.push(run);
                    }
                }
                let [all, seen] = runs.map(|runs| Kind::of(&runs));
                report.rows.push(Row {
                    gaussians: *gaussians,
                    share: *share,
                    all,
                    seen,
                });
            }
        }
        Ok(report)
    }

    /// The result as a table.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        // Writing into a string cannot fail.
        let _ = self.write(&mut text);
        text
    }

    fn write(&self, text: &mut String) -> std::fmt::Result {
        writeln!(
            text,
            "Training steps at SH degree 3 on {} threads, photos of {} pixels; random points on four sheets, of which each \
             of four views sees the share named. `sparse_share` 0 against {SPARSE_SHARE}, {ROUNDS} processes of each by turns, \
             {STEPS} steps of each process after {WARM_UP}: median (least to most).\n",
            self.threads, self.pixels
        )?;
        writeln!(
            text,
            "| Gaussians | seen | ms, all | ms, those seen | of the time | peak MB, all | peak MB, those seen |"
        )?;
        writeln!(text, "|{}", "--:|".repeat(7))?;
        for Row {
            gaussians,
            share,
            all,
            seen,
        } in &self.rows
        {
            let time = |kind: &Kind| {
                let Spread { median, min, max } = kind.milliseconds;
                format!("{median:.1} ({min:.1} to {max:.1})")
            };
            let memory = |kind: &Kind| {
                let bytes = kind.peak_rss_bytes;
                bytes.map_or(String::new(), |bytes| format!("{:.0}", bytes as f64 / 1e6))
            };
            writeln!(
                text,
                "| {gaussians} | {:.0} % | {} | {} | {:.2} | {} | {} |",
                100.0 * share,
                time(all),
                time(seen),
                seen.milliseconds.median / all.milliseconds.median,
                memory(all),
                memory(seen)
            )?;
        }
        Ok(())
    }
}
