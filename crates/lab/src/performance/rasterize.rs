//! Speed of the rasteriser: (pixel, Gaussian) evaluations per second and core (or per CubeCL
//! device), on the lists of a real scene.

use std::fmt::Write;
use std::time::{Duration, Instant};

use burn::tensor::Device;
use serde::Serialize;
use splat_data::SplatData;
use splat_model::{CameraTensors, Gaussians, RenderSettings, render};
use splat_ops::RasterizeSettings;
use splat_ops::cpu::InstructionSet;
use splat_ops::device::device_info;

use super::arithmetic::{self, Arithmetic};
use super::device_step::write_device;
use super::limits::{AVX2, AVX512, Limit, SCALAR, limit};
use super::stages::{Recording, Stage};
use super::work::sample;
use super::{Machine, PerformanceError, Spread, Work, all_threads, on_threads};
use splat_data::View;
use splat_trainer::photo;

/// Views rendered.
const VIEWS: usize = 8;
/// Unmeasured passes over the views.
const WARM_UP: usize = 1;
/// Measured passes over the views, unless time is up.
const PASSES: usize = 30;

/// The rasteriser on the views of a capture.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RasterizeReport {
    /// Machine and date.
    pub machine: Machine,
    /// Properties of the CubeCL device; absent for the CPU.
    pub device: Option<Vec<(&'static str, String)>>,
    /// The rendered scene.
    pub scene: String,
    /// The work of a view.
    pub work: Work,
    /// One row per number of threads and instruction set; a single row for a device.
    pub rows: Vec<RasterizeRow>,
}

/// Results for a number of threads and an instruction set.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RasterizeRow {
    /// Threads.
    pub threads: usize,
    /// Instruction set of the inner loops; absent for a device.
    pub instructions: Option<String>,
    /// Reference speeds.
    #[serde(skip)]
    limit: Option<Limit>,
    /// Passes over the views.
    pub passes: usize,
    /// Tile lists, milliseconds per view. Absent if the rasteriser does not time them separately.
    pub lists: Option<Spread>,
    /// Blending, including the lists if they are not separate.
    pub forward: Rate,
    /// The gradient of the blending.
    pub backward: Rate,
    /// The gradient with unordered sums; CubeCL devices only.
    pub backward_unordered: Option<Rate>,
    /// Cost of ordered sums: the time of `backward` divided by that of `backward_unordered`,
    /// alternating on each view and summed over the views of a pass.
    pub cost_of_order: Option<Spread>,
    /// Speed of the same number of CPU threads without lists, spans and memory; absent for a
    /// device.
    pub possible: Option<Arithmetic>,
    /// Milliseconds per view of projection, colours and rasteriser together, from an idle device to
    /// an idle device; CubeCL devices only.
    pub render_forward_milliseconds: Option<Spread>,
    /// The same for their gradients.
    pub render_backward_milliseconds: Option<Spread>,
}

/// Speed of a view's evaluations. Both directions count those of the forward pass.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Rate {
    /// Milliseconds per view.
    pub milliseconds: Spread,
    /// Pairs tested per second and thread, at the median time.
    pub tested_per_second: f64,
    /// Pairs blended per second and thread, at the median time.
    pub blended_per_second: f64,
}

impl Rate {
    fn new(milliseconds: Vec<f64>, work: &Work, threads: usize) -> Self {
        let milliseconds = Spread::of(milliseconds);
        let seconds = 1e-3 * milliseconds.median * threads as f64;
        Self {
            milliseconds,
            tested_per_second: work.tested / seconds,
            blended_per_second: work.blended / seconds,
        }
    }
}

/// Measures the rasteriser of `device` on up to eight of `views`; for the CPU, on one thread and on
/// all. `seconds` limits the time of each. For a CubeCL device, the rasteriser is timed from idle
/// to idle.
///
/// # Errors
/// When the scene cannot be rendered.
pub fn measure(
    scene: &str,
    data: &SplatData,
    views: &[&View],
    settings: &RenderSettings,
    device: &Device,
    seconds: f64,
    mut say: impl FnMut(&str),
) -> Result<RasterizeReport, PerformanceError> {
    let views = sample(views, VIEWS);
    say("counting the work");
    let work = Work::count(
        &Gaussians::from_data(data, device),
        &views,
        settings,
        device,
    )?;
    let facts = device_info(device);
    let mut rows = vec![];
    let runs: Vec<_> = match facts {
        Some(_) => vec![(1, None)],
        None => all_threads()
            .into_iter()
            .flat_map(|threads| {
                InstructionSet::available()
                    .into_iter()
                    .map(move |set| (threads, Some(set)))
            })
            .collect(),
    };
    for (threads, set) in runs {
        let with = set.map_or(String::new(), |set| format!(" with {set}"));
        say(&format!(
            "rasterising {} views on {threads} thread(s){with}",
            views.len()
        ));
        let measured = || {
            let possible = match set {
                Some(_) => Some(arithmetic::measure(threads)?),
                None => None,
            };
            let passes = on_threads(threads, || passes(data, &views, settings, device, seconds))?;
            Ok::<_, PerformanceError>((possible, passes))
        };
        let (possible, passes) = match set {
            Some(set) => set.at_most(measured)?,
            None => measured()?,
        };
        let per_view = |pass: &Pass, time: fn(&Pass) -> Duration| {
            1e3 * time(pass).as_secs_f64() / views.len() as f64
        };
        let times =
            |time: fn(&Pass) -> Duration| passes.iter().map(|pass| per_view(pass, time)).collect();
        let apart = passes.iter().any(|pass| !pass.lists.is_zero());
        rows.push(RasterizeRow {
            threads,
            instructions: set.map(|set| set.to_string()),
            limit: set.map(limit),
            passes: passes.len(),
            lists: apart.then(|| Spread::of(times(|pass| pass.lists))),
            forward: Rate::new(times(|pass| pass.forward), &work, threads),
            backward: Rate::new(times(|pass| pass.backward), &work, threads),
            backward_unordered: facts
                .is_some()
                .then(|| Rate::new(times(|pass| pass.unordered), &work, threads)),
            cost_of_order: facts
                .is_some()
                .then(|| Spread::of(passes.iter().map(Pass::cost_of_order).collect())),
            possible,
            render_forward_milliseconds: facts
                .is_some()
                .then(|| Spread::of(times(|pass| pass.render_forward))),
            render_backward_milliseconds: facts
                .is_some()
                .then(|| Spread::of(times(|pass| pass.render_backward))),
        });
    }
    Ok(RasterizeReport {
        machine: Machine::here(),
        device: facts,
        scene: scene.to_owned(),
        work,
        rows,
    })
}

/// Times of the rasteriser's spans over all views, and of the whole render on a CubeCL device.
#[derive(Default)]
struct Pass {
    lists: Duration,
    forward: Duration,
    backward: Duration,
    /// `backward` with unordered sums.
    unordered: Duration,
    render_forward: Duration,
    render_backward: Duration,
}

impl Pass {
    fn add(&mut self, stages: &[Stage]) {
        for stage in stages {
            match stage.name {
                "rasterize lists" => self.lists += stage.whole,
                "rasterize" => self.forward += stage.own,
                "rasterize gradient" => self.backward += stage.own,
                _ => {}
            }
        }
    }

    /// Adds the times of the same views with unordered sums.
    fn add_unordered(&mut self, stages: &[Stage]) {
        let gradients = stages
            .iter()
            .filter(|stage| stage.name == "rasterize gradient");
        self.unordered += gradients.map(|stage| stage.own).sum::<Duration>();
    }

    fn cost_of_order(&self) -> f64 {
        self.backward.as_secs_f64() / self.unordered.as_secs_f64()
    }
}

/// Renders the views and their gradients repeatedly. A CubeCL device does so three times: by stages
/// with ordered sums, by stages with unordered sums, and as a whole.
fn passes(
    data: &SplatData,
    views: &[&View],
    settings: &RenderSettings,
    device: &Device,
    seconds: f64,
) -> Result<Vec<Pass>, PerformanceError> {
    let waited_for = device_info(device).is_some().then(|| device.clone());
    let unordered = waited_for.as_ref().map(|_| RenderSettings {
        rasterize: RasterizeSettings {
            deterministic: false,
            ..settings.rasterize
        },
        ..settings.clone()
    });
    let device = device.clone().autodiff();
    let gaussians = Gaussians::from_data(data, &device);
    let inputs: Vec<_> = views
        .iter()
        .map(|view| {
            let camera = view.camera().relative_to(gaussians.origin);
            let photo = photo(view, &device)?;
            Ok((CameraTensors::from_camera(&camera, &device), photo))
        })
        .collect::<Result<_, splat_ops::OpError>>()?;
    let record = |recording: &Recording| {
        let mut passes = vec![];
        let start = Instant::now();
        for number in 0..WARM_UP + PASSES {
            let mut pass = Pass::default();
            for (at, (cameras, photo)) in inputs.iter().enumerate() {
                let stages = |settings: &RenderSettings| -> Result<_, PerformanceError> {
                    let rendered = render(&gaussians, cameras, settings)?;
                    let difference = rendered.image() - photo.clone();
                    difference.square().mean().backward();
                    Ok(recording.take())
                };
                // The order alternates between views.
                let first = unordered.as_ref().filter(|_| (number + at) % 2 == 0);
                if let Some(settings) = first {
                    pass.add_unordered(&stages(settings)?);
                }
                pass.add(&stages(settings)?);
                if let (Some(settings), None) = (&unordered, first) {
                    pass.add_unordered(&stages(settings)?);
                }
            }
            if number >= WARM_UP {
                passes.push(pass);
                if start.elapsed().as_secs_f64() > seconds {
                    break;
                }
            }
        }
        Ok(passes)
    };
    let Some(device) = waited_for else {
        return Recording::of(record);
    };
    let mut passes: Vec<Pass> = Recording::on_device(&device, record)?;
    // No subscriber is active here, so the device is not waited for inside.
    for pass in &mut passes {
        for (cameras, photo) in &inputs {
            device.sync()?;
            let start = Instant::now();
            let rendered = render(&gaussians, cameras, settings)?;
            device.sync()?;
            pass.render_forward += start.elapsed();
            let loss = (rendered.image() - photo.clone()).square().mean();
            device.sync()?;
            let start = Instant::now();
            loss.backward();
            device.sync()?;
            pass.render_backward += start.elapsed();
        }
    }
    Ok(passes)
}

impl RasterizeReport {
    /// The result as tables.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        // Writing into a string cannot fail.
        let _ = self.write(&mut text);
        text
    }

    fn write_device(
        &self,
        text: &mut String,
        facts: &[(&'static str, String)],
    ) -> std::fmt::Result {
        write_device(text, facts)?;
        writeln!(
            text,
            "\nTime per view, the device waited for before and after, and 1e9 pairs per second. Forward includes making the \
             lists. A pair is tested where a block of the tile, whose pixels walk together, meets the ellipse.\n"
        )?;
        writeln!(
            text,
            "| direction | median ms | min | max | tested | blended |"
        )?;
        writeln!(text, "|---|{}", "--:|".repeat(5))?;
        for row in &self.rows {
            let directions = [
                ("forward", Some(row.forward)),
                ("backward, summed in order", Some(row.backward)),
                ("backward, summed as it comes", row.backward_unordered),
            ];
            for (direction, rate) in directions {
                let Some(rate) = rate else { continue };
                let Spread { median, min, max } = rate.milliseconds;
                writeln!(
                    text,
                    "| {direction} | {median:.2} | {min:.2} | {max:.2} | {:.3} | {:.3} |",
                    1e-9 * rate.tested_per_second,
                    1e-9 * rate.blended_per_second
                )?;
            }
            let whole = [
                (
                    "projection, colours and forward",
                    row.render_forward_milliseconds,
                ),
                ("all of backward", row.render_backward_milliseconds),
            ];
            for (direction, milliseconds) in whole {
                if let Some(Spread { median, min, max }) = milliseconds {
                    writeln!(
                        text,
                        "| {direction} | {median:.2} | {min:.2} | {max:.2} | | |"
                    )?;
                }
            }
        }
        for row in &self.rows {
            if let Some(Spread { median, min, max }) = row.cost_of_order {
                writeln!(
                    text,
                    "\nSums in order take {median:.3} times as long as sums that are added as they come ({min:.3} to {max:.3} over \
                     {} passes), view by view one after the other.",
                    row.passes
                )?;
            }
        }
        Ok(())
    }

    fn write(&self, text: &mut String) -> std::fmt::Result {
        writeln!(text, "Scene: {}.\n", self.scene)?;
        writeln!(text, "{}", self.work.markdown())?;
        if let Some(facts) = &self.device {
            return self.write_device(text, facts);
        }
        writeln!(
            text,
            "Time per view, and 1e9 pairs per second and thread, with each set of instructions that the processor has; goal and \
             share of the limit are those of the set.{}\n",
            if self.rows.iter().any(|row| row.lists.is_none()) {
                " Forward includes making the lists."
            } else {
                ""
            }
        )?;
        writeln!(
            text,
            "| threads | instructions | direction | median ms | min | max | tested | blended | goal, tested | share of what is \
             possible here | share of the limit |"
        )?;
        writeln!(text, "|--:|---|---|{}", "--:|".repeat(8))?;
        for row in &self.rows {
            let Some(limit) = row.limit else { continue };
            let threads = format!(
                "{} | {}",
                row.threads,
                row.instructions.as_deref().unwrap_or_default()
            );
            if let Some(Spread { median, min, max }) = row.lists {
                writeln!(
                    text,
                    "| {threads} | lists | {median:.2} | {min:.2} | {max:.2} | | | | | |"
                )?;
            }
            let goals = limit.goal.map_or([None; 2], |goal| goal.map(Some));
            let here = row.possible;
            let here = [
                here.map(|here| here.forward),
                here.map(|here| here.backward),
            ];
            let directions = [("forward", row.forward), ("backward", row.backward)];
            let held_against = goals.into_iter().zip(here).zip(limit.reached);
            for ((direction, rate), ((goal, here), limit)) in
                directions.into_iter().zip(held_against)
            {
                let Spread { median, min, max } = rate.milliseconds;
                let tested = 1e-9 * rate.tested_per_second;
                let blended = 1e-9 * rate.blended_per_second;
                let goal = goal.map_or(String::new(), |goal| format!("{goal:.1}"));
                let share = |limit: Option<f64>| {
                    limit.map_or("not measured".to_owned(), |limit| {
                        format!("{:.0} %", 100.0 * tested / limit)
                    })
                };
                let (here, share) = (share(here), share(limit));
                writeln!(
                    text,
                    "| {threads} | {direction} | {median:.2} | {min:.2} | {max:.2} | {tested:.2} | {blended:.2} | {goal} | \
                     {here} | {share} |"
                )?;
            }
        }
        writeln!(
            text,
            "\nPossible here is what the same loops reach on this machine in the same run where every pixel of a tile blends \
             every splat and all is in cache, each thread by itself:"
        )?;
        for row in &self.rows {
            if let Some(Arithmetic { forward, backward }) = row.possible {
                let which = match row.threads {
                    1 => "1 thread".to_owned(),
                    threads => format!("each of {threads} threads"),
                };
                let set = row.instructions.as_deref().unwrap_or_default();
                writeln!(
                    text,
                    "- {which}, {set}: forward {forward:.2}, backward {backward:.2}"
                )?;
            }
        }
        let [avx512, avx2] = [AVX512, AVX2].map(|set| set.reached.map(Option::unwrap_or_default));
        writeln!(
            text,
            "\nThe limit is what the arithmetic alone reached on one core of a machine with AVX-512, on a tile of 16 x 16 \
             pixels with 256 splats in cache: forward {:.1} with AVX-512, {:.1} with AVX2, {:.1} in scalar code with libm; \
             backward {:.1} with AVX-512.",
            avx512[0], avx2[0], SCALAR, avx512[1]
        )
    }
}
