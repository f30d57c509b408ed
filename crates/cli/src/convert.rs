//! `splat convert`: a scene in another file format.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use clap::Args;
use splat_data::scene::{self, SceneFormat};

use super::{Failure, GlobalArgs, print};
use crate::report::{probe_file, refuse_inputs};

/// Convert a scene between file formats
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  splat convert out/saharov/scene.ply scene.spz
  splat convert scene.spz scene.ply

docs/FORMATS.md has what each format holds, and how precisely.")]
pub struct ConvertArgs {
    /// Scene to read: PLY, SPZ or SOG
    #[arg(value_name = "IN")]
    pub input: PathBuf,
    /// File to write; its extension is its format: .ply, .spz or .sog
    #[arg(value_name = "OUT")]
    pub output: PathBuf,
    /// Leave out the scene's offset from the world's zero, for formats that cannot hold it; cameras
    /// of the capture no longer match
    #[arg(long)]
    pub drop_origin: bool,
}

/// Runs the command.
pub(super) fn run(args: &ConvertArgs, global: &GlobalArgs) -> Result<(), Failure> {
    let ConvertArgs { input, output, .. } = args;
    let format = scene::format_to_write(output)?;
    let mut data = scene::read(input)?;
    probe_file(output)?;
    refuse_inputs([output.clone()], [input.as_path()])?;
    for what in &data.settings.not_understood {
        global.say(format_args!(
            "warning: {}: not followed: `{what}`",
            input.display()
        ));
    }
    if args.drop_origin {
        data.origin = [0.0; 3];
    }
    for loss in (format.losses)(&data) {
        global.say(format_args!("warning: {}: {loss}", output.display()));
    }
    let read = size_of(input);
    (format.write)(output, &data)?;
    print(&summary(
        data.len(),
        (input, read),
        (output, format, size_of(output)),
    ))
}

/// Bytes of a scene; `None` for pipes and devices, and for the index of a folder of images.
pub(super) fn size_of(path: &Path) -> Option<u64> {
    if path.extension().is_some_and(|ending| ending == "json") {
        return None;
    }
    let kind = std::fs::metadata(path).ok()?;
    kind.is_file().then_some(kind.len())
}

/// What was written, and how its size compares.
fn summary(
    count: usize,
    (input, before): (&Path, Option<u64>),
    (output, format, after): (&Path, &SceneFormat, Option<u64>),
) -> String {
    let bytes = |size: Option<u64>| size.map_or_else(|| "? bytes".into(), |n| format!("{n} bytes"));
    let mut text = format!("{}  {}\n", input.display(), bytes(before));
    let _ = write!(
        text,
        "{}  {}, {count} Gaussian(s) as {}",
        output.display(),
        bytes(after),
        format.name
    );
    if let (Some(before), Some(after)) = (before, after) {
        let ratio = before as f64 / after.max(1) as f64;
        let each = after as f64 / count.max(1) as f64;
        let _ = match ratio >= 1.0 {
            true => write!(text, ", {ratio:.1} times smaller"),
            false => write!(text, ", {:.1} times larger", 1.0 / ratio),
        };
        let _ = write!(text, ", {each:.1} bytes each");
    }
    text.push('\n');
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_compared() {
        let (a, b) = (Path::new("a.ply"), Path::new("b.spz"));
        let format = scene::format_to_write(b).unwrap();
        let text = summary(100, (a, Some(20_000)), (b, format, Some(2_500)));
        assert_eq!(
            text,
            "a.ply  20000 bytes\n\
             b.spz  2500 bytes, 100 Gaussian(s) as SPZ, 8.0 times smaller, 25.0 bytes each\n"
        );
        let larger = summary(1, (a, Some(100)), (b, format, Some(250)));
        assert!(larger.contains("2.5 times larger"), "{larger}");
        assert!(summary(1, (a, None), (b, format, None)).contains("? bytes"));
    }
}
