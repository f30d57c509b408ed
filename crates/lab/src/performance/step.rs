//! A training step on the CPU: its time on one thread and on all, by stage.

use std::fmt::Write;
use std::sync::Arc;
use std::time::{Duration, Instant};

use burn::module::Module;
use burn::tensor::Device;
use serde::Serialize;

use super::machine::Usage;
use super::stages::{Recording, Stage};
pub use super::step_row::StepRow;
use super::work::sample;
use super::{Machine, PerformanceError, Spread, Work, all_threads, on_threads};
use crate::memory::peak_rss_bytes;
use splat_data::Capture;
use splat_data::View;
use splat_trainer::{TrainSettings, Trainer};

/// Unmeasured steps: caches and the allocator fill, and spherical harmonics reach their degree.
const WARM_UP: usize = 5;
/// Measured steps per run; fewer than it takes density control to change the number of Gaussians.
const STEPS: usize = 20;
/// Measured steps per setting, over its runs, unless time is up.
const MOST_STEPS: usize = 200;
/// Views whose work is counted.
const VIEWS: usize = 16;

/// The training step of a capture's initial Gaussians.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StepReport {
    /// Machine and date.
    pub machine: Machine,
    /// Name of the capture.
    pub capture: String,
    /// The work of a view.
    pub work: Work,
    /// One per degree of spherical harmonics and number of threads.
    pub rows: Vec<StepRow>,
    /// Peak resident memory during the measurement.
    pub peak_rss_bytes: Option<u64>,
}

/// Measures steps of `capture` at degree 0, where training begins, and 3, where it ends, on one
/// thread and on all. `seconds` limits the time of each setting, beyond a run of 20 steps; `say`
/// receives progress messages.
///
/// # Errors
/// When the capture cannot be trained on.
pub fn measure(
    capture: &Arc<Capture>,
    config: &TrainSettings,
    seconds: f64,
    mut say: impl FnMut(&str),
) -> Result<StepReport, PerformanceError> {
    let threads = all_threads();
    let mut rows = vec![];
    for sh_degree in [0, 3] {
        say(&format!(
            "training steps at SH degree {sh_degree}, threads: {threads:?}"
        ));
        let config = at_degree(config, sh_degree);
        let mut samples: Vec<Samples> = threads.iter().map(|_| Samples::default()).collect();
        let start = Instant::now();
        // The settings alternate, so that other load on the machine affects them alike.
        while samples[0].steps.len() < MOST_STEPS {
            for (threads, samples) in threads.iter().zip(&mut samples) {
                let run = on_threads(*threads, || run(capture, &config, WARM_UP, STEPS))?;
                samples.append(run);
            }
            if start.elapsed().as_secs_f64() > seconds * threads.len() as f64 {
                break;
            }
        }
        let settings = threads.iter().zip(samples);
        rows.extend(settings.map(|(threads, samples)| samples.row(sh_degree, *threads)));
    }
    let peak_rss_bytes = peak_rss_bytes();
    say("counting the work");
    Ok(StepReport {
        machine: Machine::here(),
        capture: capture.name.clone(),
        work: work(capture, config)?,
        rows,
        peak_rss_bytes,
    })
}

/// Settings of a run of the usual length that evaluates spherical harmonics of degree 0, or of
/// degree 3 from the fourth step.
pub(super) fn at_degree(config: &TrainSettings, sh_degree: usize) -> TrainSettings {
    let usual = TrainSettings::default();
    TrainSettings {
        steps: usual.steps,
        sh_degree_every: if sh_degree == 0 { usual.steps } else { 1 },
        ..config.clone()
    }
}

/// Work of a capture's initial Gaussians on the CPU.
pub(super) fn work(
    capture: &Arc<Capture>,
    config: &TrainSettings,
) -> Result<Work, PerformanceError> {
    work_on(capture, config, &Device::flex())
}

/// Work of a capture's initial Gaussians, counted by the ops of `device`.
pub(super) fn work_on(
    capture: &Arc<Capture>,
    config: &TrainSettings,
    device: &Device,
) -> Result<Work, PerformanceError> {
    let trainer = trainer(capture, config, device)?;
    let gaussians = trainer.model().valid();
    let views: Vec<&View> = capture.train_views().collect();
    let settings = config.render_settings(0, trainer.scene_scale());
    Work::count(&gaussians, &sample(&views, VIEWS), &settings, device)
}

pub(super) fn trainer(
    capture: &Arc<Capture>,
    config: &TrainSettings,
    device: &Device,
) -> Result<Trainer, PerformanceError> {
    Ok(Trainer::builder(capture.clone())
        .settings(config.clone())
        .device(device.clone())
        .build()?)
}

/// Measurements of some steps.
#[derive(Default)]
pub(super) struct Samples {
    /// Seconds and stages of each step.
    pub(super) steps: Vec<(f64, Vec<Stage>)>,
    /// Resource use of all of them.
    usage: Vec<Usage>,
}

impl Samples {
    fn append(&mut self, other: Self) {
        self.steps.extend(other.steps);
        self.usage.extend(other.usage);
    }

    /// Time of a step in milliseconds.
    pub(super) fn milliseconds(&self) -> Spread {
        Spread::of(
            self.steps
                .iter()
                .map(|(seconds, _)| 1e3 * seconds)
                .collect(),
        )
    }

    fn row(&self, sh_degree: usize, threads: usize) -> StepRow {
        let per_step = |used: fn(&Usage) -> f64| {
            let known = !self.usage.is_empty();
            known.then(|| self.usage.iter().map(used).sum::<f64>() / self.steps.len() as f64)
        };
        StepRow {
            sh_degree,
            threads,
            steps: self.steps.len(),
            milliseconds: self.milliseconds(),
            stages: self.stages(),
            cpu_milliseconds: per_step(|usage| 1e3 * usage.cpu_seconds),
            page_faults: per_step(|usage| usage.page_faults),
        }
    }

    /// Median time of each stage in milliseconds, in the order of completion, and finally the time
    /// outside all stages.
    pub(super) fn stages(&self) -> Vec<(String, f64)> {
        let mut names: Vec<&str> = vec![];
        for stage in self.steps.iter().flat_map(|(_, stages)| stages) {
            if !names.contains(&stage.name) {
                names.push(stage.name);
            }
        }
        let median = |name: &str| {
            let own = |stages: &[Stage]| {
                let stage = stages.iter().find(|stage| stage.name == name);
                stage.map_or(Duration::ZERO, |stage| stage.own)
            };
            let times = self.steps.iter().map(|(_, stages)| own(stages));
            Spread::of(times.map(|time| 1e3 * time.as_secs_f64()).collect()).median
        };
        let stages = names.into_iter();
        stages.map(|name| (label(name), median(name))).collect()
    }
}

/// Label of a trainer span, for its time outside the ops.
fn label(span: &str) -> String {
    match span {
        "step" => "rest (Burn and the trainer)".to_owned(),
        "render" | "loss" | "backward" | "optimizer" => format!("{span}, outside of the ops"),
        op => op.to_owned(),
    }
}

/// Takes `warm_up` steps, then measures up to `steps` more.
pub(super) fn run(
    capture: &Arc<Capture>,
    config: &TrainSettings,
    warm_up: usize,
    steps: usize,
) -> Result<Samples, PerformanceError> {
    let mut trainer = trainer(capture, config, &Device::flex())?;
    for _ in 0..warm_up {
        trainer.step()?;
    }
    Recording::of(|recording| {
        let before = Usage::so_far();
        let mut samples = Samples::default();
        for _ in 0..steps {
            let start = Instant::now();
            trainer.step()?;
            let seconds = start.elapsed().as_secs_f64();
            samples.steps.push((seconds, recording.take()));
        }
        if let (Some(before), Some(now)) = (before, Usage::so_far()) {
            samples.usage.push(now.since(before));
        }
        Ok(samples)
    })
}

impl StepReport {
    /// Speed-up of all threads over one, by degree of spherical harmonics: (degree, threads,
    /// ratio).
    pub fn speed_ups(&self) -> Vec<(usize, usize, f64)> {
        let one = |degree| {
            let mut rows = self.rows.iter();
            rows.find(|row| row.threads == 1 && row.sh_degree == degree)
        };
        let many = self.rows.iter().filter(|row| row.threads > 1);
        many.filter_map(|row| {
            let ratio = one(row.sh_degree)?.milliseconds.median / row.milliseconds.median;
            Some((row.sh_degree, row.threads, ratio))
        })
        .collect()
    }

    /// The result as tables.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        // Writing into a string cannot fail.
        let _ = self.write(&mut text);
        text
    }

    fn write(&self, text: &mut String) -> std::fmt::Result {
        writeln!(text, "Capture {}, its first Gaussians.\n", self.capture)?;
        writeln!(text, "{}", self.work.markdown())?;
        writeln!(
            text,
            "| SH degree | threads | steps | median ms | min | max | CPU ms per step | page faults per step |"
        )?;
        writeln!(text, "|{}", "--:|".repeat(8))?;
        for row in &self.rows {
            let Spread { median, min, max } = row.milliseconds;
            let known = |value: Option<f64>| value.map_or(String::new(), |v| format!("{v:.0}"));
            writeln!(
                text,
                "| {} | {} | {} | {median:.1} | {min:.1} | {max:.1} | {} | {} |",
                row.sh_degree,
                row.threads,
                row.steps,
                known(row.cpu_milliseconds),
                known(row.page_faults)
            )?;
        }
        writeln!(text)?;
        for (degree, threads, ratio) in self.speed_ups() {
            writeln!(
                text,
                "{threads} threads are {ratio:.2} times as fast as one at SH degree {degree}."
            )?;
        }
        if let Some(bytes) = self.peak_rss_bytes {
            writeln!(text, "Peak memory: {:.0} MB.", bytes as f64 / 1e6)?;
        }
        self.write_stages(text)
    }

    fn write_stages(&self, text: &mut String) -> std::fmt::Result {
        let columns = self.rows.iter().map(|row| {
            let plural = if row.threads == 1 { "" } else { "s" };
            StageColumn {
                head: format!("degree {}, {} thread{plural}", row.sh_degree, row.threads),
                stages: &row.stages,
                step: row.milliseconds.median,
            }
        });
        write_stages(text, &columns.collect::<Vec<_>>())
    }
}

/// Stages of a step at one setting.
pub(super) struct StageColumn<'a> {
    pub(super) head: String,
    pub(super) stages: &'a [(String, f64)],
    /// Milliseconds of the whole step.
    pub(super) step: f64,
}

/// A table of stages.
pub(super) fn write_stages(text: &mut String, columns: &[StageColumn]) -> std::fmt::Result {
    let mut names: Vec<&str> = vec![];
    for (name, _) in columns.iter().flat_map(|column| column.stages) {
        if !names.contains(&name.as_str()) {
            names.push(name);
        }
    }
    writeln!(
        text,
        "\nMilliseconds by stage, each the median of its own, so that a column need not add up:\n"
    )?;
    let heads: Vec<&str> = columns.iter().map(|column| &*column.head).collect();
    writeln!(text, "| stage | {} |", heads.join(" | "))?;
    writeln!(text, "|---|{}", "--:|".repeat(columns.len()))?;
    for name in names {
        write!(text, "| {name} |")?;
        for column in columns {
            let stage = column.stages.iter().find(|(stage, _)| stage == name);
            let time = stage.map_or(String::new(), |(_, time)| format!("{time:.2}"));
            write!(text, " {time} |")?;
        }
        writeln!(text)?;
    }
    write!(text, "| **step** |")?;
    for column in columns {
        write!(text, " {:.2} |", column.step)?;
    }
    writeln!(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_data::CaptureSettings;

    #[test]
    fn stages_cover_the_step_and_its_work_is_counted() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
        let options = CaptureSettings {
            downscale: 16,
            ..CaptureSettings::default()
        };
        let capture = Arc::new(Capture::load(folder, &options).unwrap());
        let config = at_degree(&TrainSettings::default(), 3);
        let samples = on_threads(1, || run(&capture, &config, 1, 3)).unwrap();
        assert_eq!(samples.steps.len(), 3);
        for (seconds, stages) in &samples.steps {
            let names: Vec<&str> = stages.iter().map(|stage| stage.name).collect();
            for op in ["project", "colours", "rasterize"] {
                let gradient = format!("{op} gradient");
                assert!(
                    names.contains(&op) && names.contains(&gradient.as_str()),
                    "{names:?}"
                );
            }
            for stage in ["render", "loss", "backward", "adam", "optimizer", "density"] {
                assert!(names.contains(&stage), "{names:?}");
            }
            let step = stages.last().unwrap();
            assert_eq!(step.name, "step");
            let sum: Duration = stages.iter().map(|stage| stage.own).sum();
            assert_eq!(sum, step.whole);
            assert!(step.whole.as_secs_f64() <= *seconds);
        }
        let row = samples.row(3, 1);
        assert_eq!(row.stages.last().unwrap().0, "rest (Burn and the trainer)");

        let work = work(&capture, &config).unwrap();
        let (width, height, _) = capture.image_sizes()[0];
        assert_eq!(work.pixels, f64::from(width * height));
        assert_eq!((work.views, work.gaussians), (16, capture.points.len()));
        assert!(0.0 < work.visible && work.visible <= work.gaussians as f64);
        assert!(work.intersections >= work.visible / 2.0);
        assert!(0.0 < work.blended && work.blended <= work.seen && work.seen <= work.tested);
    }
}
