//! `splat info`: what a scene or a capture is.

mod capture;
mod histogram;
mod scene;

use std::path::PathBuf;

use clap::Args;
use splat_model::files::ply;

use super::photos::PhotoArgs;
use super::{Failure, GlobalArgs, print};
use crate::capture::Capture;

/// Show what a scene or a capture is: counts, bounds, histograms, cameras, warnings
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat info out/saharov/scene.ply
  splat info examples/data/saharov")]
pub struct InfoArgs {
    /// A scene file (PLY) or a capture folder
    #[arg(value_name = "SCENE|CAPTURE")]
    pub path: PathBuf,
    #[command(flatten)]
    pub photos: PhotoArgs,
}

/// Runs the command.
pub(super) fn run(args: &InfoArgs, _: &GlobalArgs) -> Result<(), Failure> {
    let path = &args.path;
    let text = if path.is_dir() {
        capture::describe(&Capture::load(path, &args.photos.options())?)
    } else {
        let scene = ply::read(path)?;
        args.photos.refuse("a scene has no photos")?;
        scene::describe(path, &scene)
    };
    print(&text);
    Ok(())
}

/// Least and greatest value of each axis; `[inf, -inf]` where there is no position.
fn bounds(positions: impl Iterator<Item = [f64; 3]>) -> [[f64; 2]; 3] {
    positions.fold(
        [[f64::INFINITY, f64::NEG_INFINITY]; 3],
        |bounds, position| {
            std::array::from_fn(|axis| {
                let [least, most] = bounds[axis];
                [least.min(position[axis]), most.max(position[axis])]
            })
        },
    )
}

/// Bounds as three lines, each axis on its own.
fn bounds_text(bounds: [[f64; 2]; 3]) -> String {
    let line =
        |(axis, [least, most]): (&str, [f64; 2])| format!("  {axis}  {least:.4} to {most:.4}\n");
    ["x", "y", "z"].into_iter().zip(bounds).map(line).collect()
}
