//! A training step on a CubeCL device: its time, the work of the kernels, the share of the device's
//! memory bandwidth, and memory.

use std::fmt::Write;
use std::sync::Arc;
use std::time::Instant;

use burn::tensor::Device;
use serde::Serialize;
use splat_ops::device::{StepSizes, copy_bandwidth, device_info, kernel_work, step_floor};

use super::device_memory::{
    DeviceMemory, PER_GAUSSIAN_AT_REST, PER_GAUSSIAN_GOAL, in_use, parameters,
};
use super::stages::Recording;
use super::step::{Samples, StageColumn, at_degree, trainer, work_on, write_stages};
use super::{Machine, PerformanceError, Spread, Work};
use splat_data::Capture;
use splat_trainer::TrainSettings;

/// Unmeasured steps: kernels are compiled, and spherical harmonics reach their degree.
const WARM_UP: usize = 5;
/// Steps measured in each way, unless time is up; at least [`LEAST`].
const STEPS: usize = 50;
const LEAST: usize = 3;
/// Bytes of the copy that measures bandwidth: more than the caches of current devices.
const COPY_BYTES: usize = 256 << 20;
/// The same for a software device, which has smaller caches and less speed.
const SOFTWARE_COPY_BYTES: usize = 64 << 20;

/// The training step of a capture's initial Gaussians on a device.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DeviceStepReport {
    /// Machine and date.
    pub machine: Machine,
    /// Properties of the device, and the kernel variants that run on it.
    pub device: Vec<(&'static str, String)>,
    /// Name of the capture.
    pub capture: String,
    /// Work per view of the device's kernels.
    pub work: Work,
    /// Bytes read and written per second by a plain copy.
    pub copy_bytes_per_second: f64,
    /// One per degree of spherical harmonics.
    pub rows: Vec<DeviceStepRow>,
}

/// Steps at one degree of spherical harmonics.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DeviceStepRow {
    /// Degree of spherical harmonics.
    pub sh_degree: usize,
    /// Steps measured in each of three ways.
    pub steps: usize,
    /// Time of a step, from an idle device to an idle device.
    pub milliseconds: Spread,
    /// Mean time of consecutive steps, as in training, with a wait after the last.
    pub milliseconds_in_a_row: f64,
    /// Launches of our kernels per step.
    pub launches: f64,
    /// Waits of the host per step.
    pub waits: f64,
    /// (tile, Gaussian) pairs listed per step.
    pub intersections: f64,
    /// Bytes reserved by our kernels per step.
    pub reserved_bytes: f64,
    /// Floor of each stage in bytes.
    pub floor: Vec<(&'static str, u64)>,
    /// Sum of the stages' floors.
    pub floor_bytes: u64,
    /// Time of a copy of the floor's bytes, as a share of a consecutive step.
    pub share_of_floor: f64,
    /// Median time of each stage, in the order of completion, and finally the time outside all
    /// stages. Measured with a wait for the device before and after every stage.
    pub stages: Vec<(String, f64)>,
    /// Memory on the device.
    pub memory: DeviceMemory,
}

/// True for a device that is a program on the host rather than hardware.
#[cfg(any(feature = "wgpu", feature = "cuda"))]
fn is_software(device: &Device) -> bool {
    let identity = device.identity();
    identity.is_none_or(|known| known.physical.is_none())
}

/// Without a feature for other devices there is only the host.
#[cfg(not(any(feature = "wgpu", feature = "cuda")))]
fn is_software(_: &Device) -> bool {
    true
}

/// Measures steps of `capture` on `device` at degree 0, where training begins, and 3, where it
/// ends. `seconds` limits the time of each way of measuring, beyond the first three steps.
///
/// # Errors
/// When the capture cannot be trained, or the device is not CubeCL's or fails.
pub fn measure(
    capture: &Arc<Capture>,
    config: &TrainSettings,
    device: &Device,
    seconds: f64,
    mut say: impl FnMut(&str),
) -> Result<DeviceStepReport, PerformanceError> {
    let facts = device_info(device).ok_or(PerformanceError::NotCubeCl)?;
    say("copying, for the device's memory bandwidth");
    let software = is_software(device);
    let bytes = if software {
        SOFTWARE_COPY_BYTES
    } else {
        COPY_BYTES
    };
    let copied = copy_bandwidth(device, bytes)?.ok_or(PerformanceError::NotCubeCl)?;
    say("counting the work");
    let work = work_on(capture, config, device)?;
    let mut rows = vec![];
    for sh_degree in [0, 3] {
        say(&format!("training steps at SH degree {sh_degree}"));
        let config = at_degree(config, sh_degree);
        let run = run(capture, &config, device, WARM_UP, seconds)?;
        rows.push(run.row(capture, device, sh_degree, &work, copied)?);
    }
    Ok(DeviceStepReport {
        machine: Machine::here(),
        device: facts,
        capture: capture.name.clone(),
        work,
        copy_bytes_per_second: copied,
        rows,
    })
}

/// Measurements of a run's steps.
pub(super) struct DeviceRun {
    /// Steps with a wait after each.
    pub(super) alone: Vec<f64>,
    /// Seconds of the consecutive steps, with a wait after the last.
    in_a_row: f64,
    launches: f64,
    waits: f64,
    intersections: f64,
    reserved_bytes: f64,
    /// Stages with a wait for the device before and after each.
    pub(super) staged: Samples,
    pub(super) memory: DeviceMemory,
}

/// Takes `warm_up` steps, then measures.
pub(super) fn run(
    capture: &Arc<Capture>,
    config: &TrainSettings,
    device: &Device,
    warm_up: usize,
    seconds: f64,
) -> Result<DeviceRun, PerformanceError> {
    device.memory_cleanup();
    let before = in_use(device)?;
    let mut trainer = trainer(capture, config, device)?;
    for _ in 0..warm_up {
        trainer.step()?;
    }
    device.sync()?;
    let done = kernel_work();
    let start = Instant::now();
    let mut alone = vec![];
    while alone.len() < LEAST || (alone.len() < STEPS && start.elapsed().as_secs_f64() < seconds) {
        let start = Instant::now();
        trainer.step()?;
        device.sync()?;
        alone.push(start.elapsed().as_secs_f64());
    }
    let done = kernel_work().since(done);
    let steps = alone.len();
    let start = Instant::now();
    for _ in 0..steps {
        trainer.step()?;
    }
    device.sync()?;
    let in_a_row = start.elapsed().as_secs_f64() / steps as f64;
    let (staged, most) = Recording::on_device(device, |recording| {
        let mut staged = Samples::default();
        for _ in 0..steps {
            let start = Instant::now();
            trainer.step()?;
            let seconds = start.elapsed().as_secs_f64();
            staged.steps.push((seconds, recording.take()));
        }
        Ok::<_, PerformanceError>((staged, recording.most_in_use()))
    })?;
    let memory = DeviceMemory::of(&trainer, device, before, most)?;
    let per_step = |count: u64| count as f64 / steps as f64;
    Ok(DeviceRun {
        alone,
        in_a_row,
        launches: per_step(done.launches),
        waits: per_step(done.waits),
        intersections: per_step(done.intersections),
        reserved_bytes: per_step(done.reserved_bytes),
        staged,
        memory,
    })
}

impl DeviceRun {
    fn row(
        self,
        capture: &Capture,
        device: &Device,
        sh_degree: usize,
        work: &Work,
        copied: f64,
    ) -> Result<DeviceStepRow, PerformanceError> {
        let (width, height, _) = capture.image_sizes().first().copied().unwrap_or_default();
        let sizes = StepSizes {
            gaussians: work.gaussians as u64,
            visible: work.visible as u64,
            intersections: self.intersections as u64,
            width: u64::from(width),
            height: u64::from(height),
            sh_degree,
            parameters: parameters(sh_degree),
        };
        let floor = step_floor(device, &sizes).ok_or(PerformanceError::NotCubeCl)?;
        let floor_bytes: u64 = floor.iter().map(|(_, bytes)| bytes).sum();
        Ok(DeviceStepRow {
            sh_degree,
            steps: self.alone.len(),
            milliseconds: Spread::of(self.alone).times(1e3),
            milliseconds_in_a_row: 1e3 * self.in_a_row,
            launches: self.launches,
            waits: self.waits,
            intersections: self.intersections,
            reserved_bytes: self.reserved_bytes,
            floor_bytes,
            share_of_floor: floor_bytes as f64 / copied / self.in_a_row,
            floor,
            stages: self.staged.stages(),
            memory: self.memory,
        })
    }
}

impl DeviceStepReport {
    /// The result as tables.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        // Writing into a string cannot fail.
        let _ = self.write(&mut text);
        text
    }

    fn write(&self, text: &mut String) -> std::fmt::Result {
        write_device(text, &self.device)?;
        writeln!(text, "\nCapture {}, its first Gaussians.\n", self.capture)?;
        writeln!(text, "{}", self.work.markdown())?;
        writeln!(
            text,
            "A pair is tested where a block of the tile, whose pixels walk together, meets the ellipse.\n"
        )?;
        writeln!(
            text,
            "| SH degree | steps | median ms | min | max | ms in a row | launches | waits | intersections | MB reserved |"
        )?;
        writeln!(text, "|{}", "--:|".repeat(10))?;
        for row in &self.rows {
            let Spread { median, min, max } = row.milliseconds;
            writeln!(
                text,
                "| {} | {} | {median:.2} | {min:.2} | {max:.2} | {:.2} | {:.1} | {:.1} | {:.0} | {:.1} |",
                row.sh_degree,
                row.steps,
                row.milliseconds_in_a_row,
                row.launches,
                row.waits,
                row.intersections,
                row.reserved_bytes / 1e6
            )?;
        }
        writeln!(
            text,
            "\nA step is timed until the device is idle; steps in a row follow each other as in training, and only the last \
             is waited for. Launches, waits and reserved bytes are those of the project's own kernels, per step; the same \
             memory may be reserved several times in a step.\n"
        )?;
        self.write_floor(text)?;
        self.write_memory(text)?;
        writeln!(
            text,
            "\nBefore and after every stage the device was waited for, which costs the step what else runs side by side."
        )?;
        let columns = self.rows.iter().map(|row| StageColumn {
            head: format!("degree {}", row.sh_degree),
            stages: &row.stages,
            step: row.milliseconds.median,
        });
        write_stages(text, &columns.collect::<Vec<_>>())
    }

    fn write_floor(&self, text: &mut String) -> std::fmt::Result {
        writeln!(
            text,
            "A plain copy moves {:.2} GB/s, read and written together. Of the bytes that the kernels cannot do without \
             (an estimate: `kernels/src/floor.rs`), and of the time that a copy of as many takes:\n",
            self.copy_bytes_per_second / 1e9
        )?;
        let heads = self
            .rows
            .iter()
            .map(|row| format!(" degree {}, MB |", row.sh_degree));
        writeln!(text, "| stage |{}", heads.collect::<String>())?;
        writeln!(text, "|---|{}", "--:|".repeat(self.rows.len()))?;
        for (index, (name, _)) in self
            .rows
            .first()
            .map_or(&[][..], |row| &row.floor)
            .iter()
            .enumerate()
        {
            write!(text, "| {name} |")?;
            for row in &self.rows {
                write!(text, " {:.2} |", row.floor[index].1 as f64 / 1e6)?;
            }
            writeln!(text)?;
        }
        let cells = |of: fn(&DeviceStepRow) -> String| {
            let cells = self.rows.iter().map(|row| format!(" {} |", of(row)));
            cells.collect::<String>()
        };
        let bytes = |row: &DeviceStepRow| format!("{:.2}", row.floor_bytes as f64 / 1e6);
        let share = |row: &DeviceStepRow| format!("{:.2} %", 100.0 * row.share_of_floor);
        writeln!(text, "| **all** |{}", cells(bytes))?;
        writeln!(text, "| **a copy's time, of the step's** |{}", cells(share))
    }

    fn write_memory(&self, text: &mut String) -> std::fmt::Result {
        for row in &self.rows {
            let memory = &row.memory;
            writeln!(
                text,
                "\nMemory at degree {}, by the device's allocator: {:.1} MB for the state between steps, {:.0} bytes per \
                 Gaussian ({PER_GAUSSIAN_AT_REST} are stated for degree 3); most in use at the ends of stages {:.1} MB, {:.0} bytes per \
                 Gaussian; {:.1} MB reserved from the device.",
                row.sh_degree,
                memory.at_rest_bytes as f64 / 1e6,
                memory.per_gaussian(memory.at_rest_bytes),
                memory.most_bytes as f64 / 1e6,
                memory.per_gaussian(memory.most_bytes),
                memory.reserved_bytes as f64 / 1e6
            )?;
        }
        writeln!(
            text,
            "\nA million Gaussians of degree 3 have {:.2} GB of training state (at most {:.1} GB is the goal), the \
             rasteriser's scratch apart.",
            PER_GAUSSIAN_AT_REST as f64 * 1e6 / 1e9,
            PER_GAUSSIAN_GOAL as f64 * 1e6 / 1e9
        )
    }
}

/// Properties of a device, as a list.
pub(super) fn write_device(
    text: &mut String,
    facts: &[(&'static str, String)],
) -> std::fmt::Result {
    writeln!(text, "Device:\n")?;
    for (name, value) in facts {
        writeln!(text, "- {name}: {value}")?;
    }
    Ok(())
}
