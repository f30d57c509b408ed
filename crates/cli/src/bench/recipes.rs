//! `splat bench recipes`: what every recipe gives, and what it takes.
//!
//! A row of `recipes.csv` is one run: a recipe on a capture with a seed. Tables, plot and pictures
//! are made of these rows and of the renders beside them, so that a second call measures nothing
//! that an earlier one has measured.

mod comparison;
mod csv;
mod measure;
mod page;
mod pictures;
mod plan;
mod plot;
mod row;
mod statistics;
mod turns;

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;

use super::{Failure, GlobalArgs, device, print, write, write_svg};
use crate::command_line::CommandLine;
use crate::interrupt;
use crate::photos::PhotoArgs;
use crate::report::{probe_file, probe_folder};
use csv::Table;
use measure::Bench;
use page::Page;
use plan::{Named, Plan};
use splat_lab::performance::Machine;
use turns::{Ended, Turns};

/// The rows of all runs.
const CSV: &str = "recipes.csv";
/// The tables.
const PAGE: &str = "recipes.md";
/// The plot.
const SVG: &str = "recipes.svg";
/// Most seeds.
const MOST_SEEDS: u64 = 1000;

/// Recipes on captures: held-out PSNR against training time, Gaussians and bytes
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat bench recipes examples/data/saharov --downscale 4 --steps 2000
  splat bench recipes garden/ truck/ --recipes default,mcmc --downscale 4 --out out/compared
  splat bench recipes garden/ --recipes default,mine.toml --downscale 4

Trains every recipe on every capture with every seed, in turns, and writes to DIR: recipes.csv (a row
for each run, saved as soon as it ends), recipes.md (the tables that are printed), recipes.svg, and for
each capture a picture of its worst-scored held-out view, CAPTURE.png. Ctrl-C drops the run that is in
progress; the same command then goes on with what is missing. A recipe whose settings have changed is
measured anew.")]
pub(super) struct RecipesArgs {
    /// Captures: folders with `images/` and `sparse/0/`
    #[arg(required = true, value_name = "CAPTURE")]
    captures: Vec<PathBuf>,
    /// Recipes to measure, or files as for `splat train --config`; the others are compared with the
    /// first [default: all recipes]
    #[arg(long, value_name = "NAME|FILE,...", value_delimiter = ',')]
    recipes: Vec<String>,
    /// Number of steps of a run; the recipe's milestones scale with it [default: the recipe's,
    /// 30000]
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    #[command(flatten)]
    photos: PhotoArgs,
    /// Runs of each recipe on each capture, with the seeds 0, 1, ...
    #[arg(long, value_name = "N", default_value_t = 3,
        value_parser = clap::value_parser!(u64).range(1..=MOST_SEEDS))]
    seeds: u64,
    /// Folder to write to, and to go on in
    #[arg(long, value_name = "DIR", default_value = "out/recipes")]
    out: PathBuf,
}

/// Runs the command.
pub(super) fn run(args: &RecipesArgs, global: &GlobalArgs) -> Result<(), Failure> {
    let started = Instant::now();
    let interrupt = interrupt::flag()?;
    if global.seed.is_some() {
        return Err(Failure::BadInput(
            "--seed: the runs have the seeds 0, 1, ...; say how many with --seeds".to_owned(),
        ));
    }
    let mut plan = Plan::new(args.recipes()?, args.seeds, args.steps, args.photos.clone())?;
    plan.take_captures(&args.captures, &args.out)?;
    let chosen = device::open(global)?;
    plan.device = chosen.name.clone();
    let mut table = Table::open(args.out.join(CSV))?;
    args.probe(&plan)?;

    let turns = Turns {
        plan: &plan,
        bench: Bench {
            folder: &args.out,
            device: &chosen.device,
            interrupt,
            global,
        },
        again: args.again(global),
    };
    let ended = turns.take(&mut table, started);
    // Whatever ended the runs, those before are kept.
    let reported = report(args, &plan, &table, global);
    let ended = ended?;
    reported?;
    turns.say_how_it_ended(&ended, &table);
    failed(&ended)
}

impl RecipesArgs {
    /// The chosen recipes, or all.
    fn recipes(&self) -> Result<Vec<Named>, Failure> {
        match self.recipes.is_empty() {
            true => Ok(Named::recipes()),
            false => self
                .recipes
                .iter()
                .map(|text| Named::of_text(text))
                .collect(),
        }
    }

    /// Checks that everything can be written, before the long work.
    fn probe(&self, plan: &Plan) -> Result<(), Failure> {
        probe_folder(&self.out)?;
        for name in [CSV, PAGE, SVG] {
            probe_file(&self.out.join(name))?;
        }
        for capture in &plan.captures {
            probe_file(&pictures::of_capture(&self.out, &capture.name))?;
        }
        Ok(())
    }

    /// The command that goes on with what is missing.
    fn again(&self, global: &GlobalArgs) -> CommandLine {
        let mut options = vec![("--seeds", self.seeds.to_string())];
        options.extend(self.steps.map(|steps| ("--steps", steps.to_string())));
        if !self.recipes.is_empty() {
            options.push(("--recipes", self.recipes.join(",")));
        }
        let mut line = CommandLine::new("bench recipes", global);
        for capture in &self.captures {
            line = line.path(capture);
        }
        for (name, value) in options {
            line = line.option(name, Path::new(&value));
        }
        line.photos(&self.photos).option("--out", &self.out)
    }
}

/// Prints the tables of what is measured, and writes them with plot and pictures.
fn report(
    args: &RecipesArgs,
    plan: &Plan,
    table: &Table,
    global: &GlobalArgs,
) -> Result<(), Failure> {
    let started = Instant::now();
    let rows = plan.measured(&table.rows);
    if rows.is_empty() {
        return Ok(());
    }
    let captures: Vec<&str> = plan.captures.iter().map(|c| c.name.as_str()).collect();
    let mut shown = Vec::new();
    for capture in &captures {
        shown.extend(pictures::assemble(
            &args.out,
            capture,
            plan.downscale,
            &rows,
            &table.rows,
        )?);
    }
    write_svg(&args.out.join(SVG), plot::svg(&captures, &rows))?;
    let command = args.again(global);
    let page = Page {
        plan,
        rows: &rows,
        shown: &shown,
        command: command.in_a_line().unwrap_or("splat bench recipes"),
        machine: &Machine::here().line(),
        reporting: started.elapsed(),
    };
    write(&args.out, PAGE, &page.markdown())?;
    print(&page.tables())
}

/// An error that names the runs without a result, if there are any.
fn failed(ended: &Ended) -> Result<(), Failure> {
    match ended.failed.first() {
        None => Ok(()),
        Some(first) => Err(Failure::Check(format!(
            "{} run(s) have no result, the same command tries them again; the first: {first}",
            ended.failed.len()
        ))),
    }
}
