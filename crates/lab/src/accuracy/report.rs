//! Error against time for every case and backend, as rows, a Markdown table, and a plot.

use std::fmt::Write;
use std::time::Instant;

use burn::tensor::Device;
use serde::Serialize;

use super::lenses::{LensRow, lens_rows};
use super::measure::single;
use super::model_error::{ModelErrorRow, Shape, model_error_table};
use super::projection::{ProjectionErrors, projection_errors};
use super::{AccuracyError, Case, cases};

/// Random extreme Gaussians for measuring the projection.
const GAUSSIANS: usize = 1_000_000;
/// Number of runs for the median time.
const RUNS: usize = 5;

/// A named device.
pub struct Backend {
    /// Short name: cpu, wgpu.
    pub name: String,
    /// Name with the adapter.
    pub description: String,
    /// The device.
    pub device: Device,
}

/// A case on a backend: one point of error against time.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// Number of the case.
    pub case: u8,
    /// Its name.
    pub name: &'static str,
    /// Additional demand, besides the relative L2 error of 1e-3.
    pub demand: &'static str,
    /// Backend.
    pub backend: String,
    /// Relative L2 error of the image in single precision.
    pub forward: f64,
    /// Relative L2 error of the worst parameter group.
    pub gradient: f64,
    /// Name of that group.
    pub worst_group: String,
    /// True if the case's demand holds.
    pub holds: bool,
    /// Seconds of forward and backward pass of the case's scenes, with upload and read-back; absent
    /// if nothing is rendered.
    pub seconds: Option<f64>,
    /// (Pixel, splat) pairs blended in that time, forward.
    pub blended: u64,
    /// Pixels within 1e-6 of a threshold.
    pub near_threshold: usize,
    /// Additional findings.
    pub detail: String,
}

/// All measurements.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// The machine.
    pub machine: String,
    /// Cases by number, each on every backend.
    pub cases: Vec<Row>,
    /// The projection of extreme Gaussians, per backend.
    pub projection: Vec<(String, ProjectionErrors)>,
    /// Time and error of the projection, per camera model and backend.
    pub lenses: Vec<LensRow>,
    /// Deviation of the affine projection from the 3D model.
    pub model: Vec<ModelErrorRow>,
}

impl Report {
    /// Measures everything; `each` is called before every case.
    ///
    /// # Errors
    /// When a device or an op refuses valid input. An inaccurate result is a row that does not
    /// hold.
    pub fn measure(
        backends: &[Backend],
        mut each: impl FnMut(&Backend, &Case),
    ) -> Result<Self, AccuracyError> {
        let mut rows = vec![];
        let mut projection = vec![];
        let mut lenses = vec![];
        for case in cases() {
            for backend in backends {
                each(backend, &case);
                rows.push(measure(&case, backend)?);
            }
        }
        for backend in backends {
            let errors = projection_errors(GAUSSIANS, 1, &backend.device)?;
            projection.push((backend.name.clone(), errors));
            lenses.extend(lens_rows(&backend.name, &backend.device)?);
        }
        Ok(Self {
            machine: machine(),
            cases: rows,
            projection,
            lenses,
            model: model_error_table(&Device::flex())
                .map_err(|error| AccuracyError::Read(error.to_string()))?,
        })
    }

    /// Rows whose demand does not hold.
    pub fn failures(&self) -> impl Iterator<Item = &Row> {
        self.cases.iter().filter(|row| !row.holds)
    }

    /// The tables of `docs/ACCURACY.md`.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        // Writing into a string cannot fail.
        let _ = self.write_cases(&mut text);
        let _ = self.write_projection(&mut text);
        let _ = self.write_lenses(&mut text);
        let _ = self.write_model(&mut text);
        text
    }

    fn write_cases(&self, text: &mut String) -> std::fmt::Result {
        writeln!(text, "## Hard cases\n")?;
        writeln!(
            text,
            "Relative L2 error of the image and of the worst parameter group, single precision against double; time of one \
             forward and backward of the case's scenes with upload and read-back.\n"
        )?;
        writeln!(
            text,
            "| # | case | demand | backend | image | gradient | worst group | ms | blended | holds | |"
        )?;
        writeln!(text, "|--:|---|---|---|--:|--:|---|--:|--:|---|---|")?;
        for row in &self.cases {
            let time = row
                .seconds
                .map_or(String::new(), |s| format!("{:.1}", 1e3 * s));
            writeln!(
                text,
                "| {} | {} | {} | {} | {:.1e} | {:.1e} | {} | {} | {} | {} | {} |",
                row.case,
                row.name,
                row.demand,
                row.backend,
                row.forward,
                row.gradient,
                row.worst_group,
                time,
                row.blended,
                if row.holds { "yes" } else { "**no**" },
                row.detail.replace('|', "/")
            )?;
        }
        let mut worst: Vec<&Row> = self.cases.iter().collect();
        worst.sort_by(|a, b| {
            b.gradient
                .max(b.forward)
                .total_cmp(&a.gradient.max(a.forward))
        });
        writeln!(text, "\nThe five worst: ")?;
        for row in worst.iter().take(5) {
            writeln!(
                text,
                "- case {} on {}: image {:.1e}, gradient {:.1e} {}",
                row.case, row.backend, row.forward, row.gradient, row.worst_group
            )?;
        }
        writeln!(text)
    }

    fn write_projection(&self, text: &mut String) -> std::fmt::Result {
        writeln!(text, "## Projection of extreme Gaussians\n")?;
        writeln!(
            text,
            "Random Gaussians with axes of 1e-4 to 1e4 pixels, up to 10,000 : 1, in every direction, quaternions of length 1e-9 \
             to 1e9.\n"
        )?;
        writeln!(
            text,
            "| backend | Gaussians | visible | visible but culled | determinant | exponent |"
        )?;
        writeln!(text, "|---|--:|--:|--:|--:|--:|")?;
        for (backend, e) in &self.projection {
            writeln!(
                text,
                "| {backend} | {} | {} | {} | {:.1e} | {:.1e} |",
                e.gaussians, e.visible, e.culled_but_visible, e.determinant, e.exponent
            )?;
        }
        writeln!(text)
    }

    fn write_lenses(&self, text: &mut String) -> std::fmt::Result {
        writeln!(text, "## Projection by camera model\n")?;
        writeln!(
            text,
            "100,000 Gaussians all over an image of 640 x 480: nanoseconds per Gaussian, backward without and with gradients of the \
             camera, and relative L2 error of single precision against double.\n"
        )?;
        writeln!(
            text,
            "| lens | backend | forward (ns) | backward (ns) | with camera (ns) | splats | gradient | worst group |"
        )?;
        writeln!(text, "|---|---|--:|--:|--:|--:|--:|---|")?;
        for row in &self.lenses {
            let [forward, backward, camera] = row.nanoseconds;
            writeln!(
                text,
                "| {} | {} | {forward:.0} | {backward:.0} | {camera:.0} | {:.1e} | {:.1e} | {} |",
                row.name, row.backend, row.forward, row.gradient, row.worst_group
            )?;
        }
        writeln!(text)
    }

    fn write_model(&self, text: &mut String) -> std::fmt::Result {
        writeln!(
            text,
            "## Model error: the affine projection against the 3D Gaussian\n"
        )?;
        writeln!(
            text,
            "No rounding error: both in double precision. Relative L2 error of the alpha of one splat of 9 pixels, affine (EWA) \
             projection against the 3D Gaussian integrated along every pixel's ray, without the low-pass filter; by distance \
             in standard deviations and by angle off the optical axis.\n"
        )?;
        for shape in [Shape::Sphere, Shape::Needle, Shape::Pancake] {
            let rows: Vec<_> = self
                .model
                .iter()
                .filter(|row| row.shape == shape && row.pixels == 9.0)
                .collect();
            let mut angles: Vec<f64> = rows.iter().map(|row| row.angle).collect();
            angles.sort_by(f64::total_cmp);
            angles.dedup();
            let mut distances: Vec<f64> = rows.iter().map(|row| row.distance).collect();
            distances.sort_by(f64::total_cmp);
            distances.dedup();
            let heads: Vec<String> = angles.iter().map(|angle| format!("{angle}°")).collect();
            writeln!(text, "| {shape:?}, distance | {} |", heads.join(" | "))?;
            writeln!(text, "|--:|{}", "--:|".repeat(angles.len()))?;
            for distance in distances {
                let cells: Vec<String> = angles
                    .iter()
                    .map(|angle| {
                        let found = rows
                            .iter()
                            .find(|r| r.distance == distance && r.angle == *angle);
                        found.map_or(String::new(), |row| format!("{:.2e}", row.relative_l2))
                    })
                    .collect();
                writeln!(text, "| {distance} | {} |", cells.join(" | "))?;
            }
            writeln!(text)?;
        }
        Ok(())
    }
}

fn measure(case: &Case, backend: &Backend) -> Result<Row, AccuracyError> {
    let outcome = case.measure(&backend.device)?;
    let scenes = case.timed_scenes();
    let mut times = vec![];
    // The first run compiles kernels and warms caches.
    for run in 0..=RUNS {
        let start = Instant::now();
        for scene in &scenes {
            single(scene, &backend.device)?;
        }
        if run > 0 {
            times.push(start.elapsed().as_secs_f64());
        }
    }
    times.sort_by(f64::total_cmp);
    Ok(Row {
        case: case.number,
        name: case.name,
        demand: case.demand,
        backend: backend.name.clone(),
        forward: outcome.forward,
        gradient: outcome.gradient,
        worst_group: outcome.worst_group,
        holds: outcome.holds,
        seconds: (!scenes.is_empty()).then(|| times[RUNS / 2]),
        blended: outcome.blended,
        near_threshold: outcome.near_threshold,
        detail: outcome.detail,
    })
}

/// Description of the machine, as far as the system reports it.
pub fn machine() -> String {
    let model = std::fs::read_to_string("/proc/cpuinfo")
        .ok()
        .and_then(|text| {
            let line = text.lines().find(|line| line.starts_with("model name"))?;
            Some(line.split_once(':')?.1.trim().to_owned())
        });
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get());
    format!(
        "{}, {threads} threads, {} {}",
        model.unwrap_or_else(|| "unknown processor".to_owned()),
        std::env::consts::OS,
        std::env::consts::ARCH
    )
}
