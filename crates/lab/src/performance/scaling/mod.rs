//! Growth of step time and memory with Gaussians and pixels.
//!
//! Every point is measured in its own process, so that peak memory is its own.

mod fit;
mod scene;

use std::fmt::Write;
use std::sync::Arc;

use burn::tensor::Device;
use serde::{Deserialize, Serialize};
use splat_ops::device::device_info;

pub use fit::{MemoryFit, gaussians, pixels, steepest};
pub use scene::{PhotoSize, partly_seen_capture, synthetic_capture};

use super::device_step::{self, write_device};
use super::step::{StageColumn, at_degree, run, work_on, write_stages};
use super::{DeviceMemory, Machine, PerformanceError, Spread, Work, all_threads, on_threads};
use crate::memory::peak_rss_bytes;
use splat_trainer::TrainSettings;

/// Numbers of Gaussians.
pub const GAUSSIANS: [usize; 3] = [10_000, 100_000, 1_000_000];
/// Numbers of pixels.
pub const PIXELS: [usize; 3] = [100_000, 500_000, 2_000_000];
/// Unmeasured steps, of which the fourth is the first at degree 3.
const WARM_UP: usize = 4;
/// Measured steps per point: the most if Gaussians and pixels together are at most `STEP_WORK`,
/// proportionally fewer if they are more.
const STEPS: core::ops::RangeInclusive<usize> = 3..=20;
const STEP_WORK: usize = 300_000;
/// Seconds for each way of measuring a point's steps on a CubeCL device, beyond the first three
/// steps.
const DEVICE_SECONDS: f64 = 5.0;

/// All points.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ScalingReport {
    /// Machine and date.
    pub machine: Machine,
    /// Properties of the CubeCL device; absent for the CPU.
    pub device: Option<Vec<(&'static str, String)>>,
    /// Points in the order of measurement.
    pub points: Vec<Point>,
    /// Memory as a sum of terms; absent if the system does not report memory, or too few points
    /// were measured.
    pub memory: Option<MemoryFit>,
}

/// A point: a number of Gaussians and of pixels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// Work per view; its numbers of Gaussians and pixels are the requested ones, as closely as
    /// images allow.
    pub work: Work,
    /// Threads.
    pub threads: usize,
    /// Steps measured.
    pub steps: usize,
    /// Time of a step.
    pub milliseconds: Spread,
    /// Median time of each stage, in the order of completion, and finally the time outside all
    /// stages.
    pub stages: Vec<(String, f64)>,
    /// Peak resident memory.
    pub peak_rss_bytes: Option<u64>,
    /// Memory on the CubeCL device; absent for the CPU.
    pub device_memory: Option<DeviceMemory>,
}

impl Point {
    /// Peak memory of the device, if it has its own; else of the process.
    pub fn memory(&self) -> Option<u64> {
        let device = self.device_memory.map(|memory| memory.most_bytes);
        device.or(self.peak_rss_bytes)
    }
}

/// Measures one point in this process, on `device`.
///
/// # Errors
/// When a step fails.
pub fn measure_point(
    gaussians: usize,
    size: PhotoSize,
    device: &Device,
) -> Result<Point, PerformanceError> {
    let capture = Arc::new(synthetic_capture(gaussians, size));
    let config = at_degree(&TrainSettings::default(), 3);
    if device_info(device).is_some() {
        let run = device_step::run(&capture, &config, device, WARM_UP, DEVICE_SECONDS)?;
        return Ok(Point {
            work: work_on(&capture, &config, device)?,
            threads: 1,
            steps: run.alone.len(),
            milliseconds: Spread::of(run.alone).times(1e3),
            stages: run.staged.stages(),
            peak_rss_bytes: peak_rss_bytes(),
            device_memory: Some(run.memory),
        });
    }
    let threads = all_threads().into_iter().max().unwrap_or(1);
    let most = *STEPS.end() * STEP_WORK / (gaussians + size.pixels()).max(1);
    let steps = most.clamp(*STEPS.start(), *STEPS.end());
    let samples = on_threads(threads, || run(&capture, &config, WARM_UP, steps))?;
    // Read before the work is counted, which takes memory too.
    let peak_rss_bytes = peak_rss_bytes();
    Ok(Point {
        work: work_on(&capture, &config, device)?,
        threads,
        steps,
        milliseconds: samples.milliseconds(),
        stages: samples.stages(),
        peak_rss_bytes,
        device_memory: None,
    })
}

impl ScalingReport {
    /// Measures all points on `device`, each by `measure`, which receives Gaussians and size.
    ///
    /// # Errors
    /// The error of the first point that fails.
    pub fn of(
        gaussians: &[usize],
        sizes: &[PhotoSize],
        device: &Device,
        mut measure: impl FnMut(usize, PhotoSize) -> Result<Point, PerformanceError>,
    ) -> Result<Self, PerformanceError> {
        let mut points = vec![];
        for size in sizes {
            for gaussians in gaussians {
                points.push(measure(*gaussians, *size)?);
            }
        }
        Ok(Self {
            machine: Machine::here(),
            device: device_info(device),
            memory: MemoryFit::of(&points),
            points,
        })
    }

    /// The result as tables.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        // Writing into a string cannot fail.
        let _ = self.write(&mut text);
        text
    }

    fn write(&self, text: &mut String) -> std::fmt::Result {
        let on = match &self.device {
            Some(facts) => {
                write_device(text, facts)?;
                writeln!(text)?;
                "the device, each begun and ended while it is idle".to_owned()
            }
            None => {
                let threads = self.points.first().map_or(1, |point| point.threads);
                format!("{threads} threads")
            }
        };
        writeln!(
            text,
            "Training steps at SH degree 3 on {on}; random points on four sheets that fill the view, so that a pixel \
             has about as many Gaussians however many there are. Each point in a process of its own.\n"
        )?;
        writeln!(
            text,
            "| Gaussians | pixels | intersections | tested per pixel | past the cut | blended | steps | median ms | min | max | peak MB |"
        )?;
        writeln!(text, "|{}", "--:|".repeat(11))?;
        for point in &self.points {
            let work = &point.work;
            let per_pixel = |count: f64| count / work.pixels.max(1.0);
            let Spread { median, min, max } = point.milliseconds;
            let memory = point.memory();
            writeln!(
                text,
                "| {} | {:.0} | {:.0} | {:.1} | {:.1} | {:.1} | {} | {median:.1} | {min:.1} | {max:.1} | {} |",
                work.gaussians,
                work.pixels,
                work.intersections,
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
