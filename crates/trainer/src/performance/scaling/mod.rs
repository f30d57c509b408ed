//! How step time and memory grow with Gaussians and pixels.
//!
//! Every point is measured in a process of its own, so that its peak memory is its own.

mod fit;
mod plot;
mod scene;

use std::fmt::Write;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

pub use fit::{MemoryFit, steepest};
pub use scene::synthetic_capture;

use super::step::{StageColumn, at_degree, run, work, write_stages};
use super::{Machine, PerformanceError, Spread, Work, all_threads, on_threads};
use crate::TrainConfig;
use crate::report::memory::peak_rss_bytes;

/// Numbers of Gaussians.
pub const GAUSSIANS: [usize; 3] = [10_000, 100_000, 1_000_000];
/// Numbers of pixels.
pub const PIXELS: [usize; 3] = [100_000, 500_000, 2_000_000];
/// Steps before the clock starts, of which the fourth is the first at degree 3.
const WARM_UP: usize = 4;
/// Steps measured at a point: the most where Gaussians and pixels together are no more than `STEP_WORK`, fewer in
/// proportion where they are more.
const STEPS: core::ops::RangeInclusive<usize> = 3..=20;
const STEP_WORK: usize = 300_000;

/// All points.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ScalingReport {
    /// Where and when.
    pub machine: Machine,
    /// Points in the order they were measured.
    pub points: Vec<Point>,
    /// Memory as a sum over what there is; absent where the system does not say, or too few points were measured.
    pub memory: Option<MemoryFit>,
}

/// So many Gaussians and pixels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// The work of a view; its counts of Gaussians and pixels are what was asked for, as nearly as images go.
    pub work: Work,
    /// Threads.
    pub threads: usize,
    /// Steps measured.
    pub steps: usize,
    /// Time of a step.
    pub milliseconds: Spread,
    /// Median time of each stage, in the order in which they end; last what no stage covers.
    pub stages: Vec<(String, f64)>,
    /// Most memory that was resident.
    pub peak_rss_bytes: Option<u64>,
}

/// Measures one point in this process.
///
/// # Errors
/// When a step cannot be taken.
pub fn measure_point(gaussians: usize, pixels: usize) -> Result<Point, PerformanceError> {
    let capture = Arc::new(synthetic_capture(gaussians, pixels));
    let config = at_degree(&TrainConfig::default(), 3);
    let threads = all_threads().into_iter().max().unwrap_or(1);
    let most = *STEPS.end() * STEP_WORK / (gaussians + pixels).max(1);
    let steps = most.clamp(*STEPS.start(), *STEPS.end());
    let samples = on_threads(threads, || run(&capture, &config, WARM_UP, steps))?;
    // Before the work is counted, which takes memory too.
    let peak_rss_bytes = peak_rss_bytes();
    Ok(Point {
        work: work(&capture, &config)?,
        threads,
        steps,
        milliseconds: samples.milliseconds(),
        stages: samples.stages(),
        peak_rss_bytes,
    })
}

impl ScalingReport {
    /// Measures all points, each by `measure`, which gets Gaussians and pixels.
    ///
    /// # Errors
    /// That of the first point that has one.
    pub fn of(
        gaussians: &[usize],
        pixels: &[usize],
        mut measure: impl FnMut(usize, usize) -> Result<Point, PerformanceError>,
    ) -> Result<Self, PerformanceError> {
        let mut points = vec![];
        for pixels in pixels {
            for gaussians in gaussians {
                points.push(measure(*gaussians, *pixels)?);
            }
        }
        Ok(Self {
            machine: Machine::here(),
            memory: MemoryFit::of(&points),
            points,
        })
    }

    /// The curves of step time and memory, as SVG.
    ///
    /// # Errors
    /// What the drawing library says.
    pub fn svg(&self) -> Result<String, String> {
        plot::svg(&self.points)
    }

    /// The tables.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        // Writing into a string cannot fail.
        let _ = self.write(&mut text);
        text
    }

    fn write(&self, text: &mut String) -> std::fmt::Result {
        writeln!(
            text,
            "Training steps at SH degree 3 on {} threads; random points on four sheets that fill the view, so that a pixel \
             has about as many Gaussians however many there are. Each point in a process of its own.\n",
            self.points.first().map_or(1, |point| point.threads)
        )?;
        writeln!(
            text,
            "| Gaussians | pixels | instances | tested per pixel | past the cut | blended | steps | median ms | min | max | peak MB |"
        )?;
        writeln!(text, "|{}", "--:|".repeat(11))?;
        for point in &self.points {
            let work = &point.work;
            let per_pixel = |count: f64| count / work.pixels.max(1.0);
            let Spread { median, min, max } = point.milliseconds;
            let memory = point.peak_rss_bytes;
            writeln!(
                text,
                "| {} | {:.0} | {:.0} | {:.1} | {:.1} | {:.1} | {} | {median:.1} | {min:.1} | {max:.1} | {} |",
                work.gaussians,
                work.pixels,
                work.instances,
                per_pixel(work.tested),
                per_pixel(work.seen),
                per_pixel(work.blended),
                point.steps,
                memory.map_or(String::new(), |bytes| format!("{:.0}", bytes as f64 / 1e6))
            )?;
        }
        for (name, size) in [
            ("Gaussians", fit::gaussians as fn(&Point) -> f64),
            ("pixels", fit::pixels),
        ] {
            if let Some(exponent) = steepest(&self.points, size) {
                writeln!(
                    text,
                    "\nBetween neighbouring points, step time grows at most as {name}^{exponent:.2}."
                )?;
            }
        }
        if let Some(memory) = &self.memory {
            writeln!(text, "\n{memory}")?;
        }
        let most = self.points.iter().map(fit::pixels).fold(0.0, f64::max);
        let columns = self
            .points
            .iter()
            .filter(|point| fit::pixels(point) == most);
        let columns = columns.map(|point| StageColumn {
            head: format!("{} Gaussians, {most:.0} pixels", point.work.gaussians),
            stages: &point.stages,
            step: point.milliseconds.median,
        });
        write_stages(text, &columns.collect::<Vec<_>>())
    }
}
