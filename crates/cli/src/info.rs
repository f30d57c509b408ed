//! `splat info`: contents of a scene or a capture.

mod capture;
mod histogram;
mod scene;

use std::path::PathBuf;

use clap::Args;

use super::photos::PhotoArgs;
use super::{Failure, GlobalArgs, print};
use splat_data::Capture;

/// Show what a scene or a capture is: counts, bounds, histograms, cameras, warnings
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat info out/saharov/scene.ply
  splat info examples/data/saharov")]
pub struct InfoArgs {
    /// A scene file (PLY, SPZ or SOG) or a capture folder
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
        let scene = splat_data::scene::read(path)?;
        args.photos.refuse("a scene has no photos")?;
        scene::describe(path, &scene)
    };
    print(&text)?;
    Ok(())
}

/// Smallest and largest value of each axis; `[inf, -inf]` if there are no positions.
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

/// Bounds as three lines, one per axis, with enough digits for an extent in any unit.
fn bounds_text(bounds: [[f64; 2]; 3]) -> String {
    let line = |(axis, [least, most]): (&str, [f64; 2])| {
        let extent = most - least;
        let digits = match extent.log10().floor() {
            magnitude if magnitude.is_finite() => 4 + (-magnitude).clamp(0.0, 20.0) as usize,
            _ => 4,
        };
        format!("  {axis}  {least:.digits$} to {most:.digits$}\n")
    };
    ["x", "y", "z"].into_iter().zip(bounds).map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::bounds_text;

    #[test]
    fn bounds_can_be_read_in_any_unit() {
        let text = bounds_text([[-1.0, 1.5], [2e-6, 5e-6], [3.0, 3.0]]);
        assert_eq!(
            text,
            "  x  -1.0000 to 1.5000\n  y  0.0000020000 to 0.0000050000\n  z  3.0000 to 3.0000\n"
        );
    }
}
