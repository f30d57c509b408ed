//! Options for reading photos, shared by all commands that read a capture.

use std::ffi::OsString;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use clap::Args;

use super::command_line::quoted;
use super::train::{CAMERAS, UNDISTORTED};
use super::{Failure, GlobalArgs};
use crate::report::progress::Progress;
use splat_data::{Capture, CaptureError, CaptureSettings, SplitRule};

/// Options of commands that read a capture.
#[derive(Debug, Clone, Default, Args)]
pub struct PhotoArgs {
    /// Area-average the photos by this factor [default: 1]
    #[arg(long, value_name = "K")]
    pub downscale: Option<u32>,
    /// Folder of the photos, relative to the capture or absolute [default: images]
    #[arg(long, value_name = "DIR")]
    pub images: Option<PathBuf>,
    /// Folder with a COLMAP model whose cameras and poses the views have in place of the capture's,
    /// by name: `cameras/` of a run that refined them
    #[arg(long, value_name = "DIR")]
    pub cameras: Option<PathBuf>,
    /// Views to hold out of training: every K-th by name (0: none), names separated by commas, or a
    /// file that names them [default: those that the capture says, or every 8th]
    #[arg(long, value_name = "K|NAMES|FILE")]
    pub hold_out: Option<String>,
    /// Memory for photos in MiB; if they take more, they are read from the disk whenever they are
    /// needed [default: half of what is free]
    #[arg(long, value_name = "MIB", value_parser = clap::value_parser!(u64).range(1..=1 << 30))]
    pub photo_memory: Option<u64>,
}

/// The rule that a value of `--hold-out` is.
fn hold_out(value: &str) -> SplitRule {
    if let Ok(interval) = value.parse() {
        return SplitRule::Every(interval);
    }
    let path = Path::new(value);
    if path.is_file() {
        return SplitRule::File(path.to_path_buf());
    }
    SplitRule::Names(
        value
            .split(',')
            .map(|name| name.trim().to_owned())
            .collect(),
    )
}

/// Reads a capture, with a bar on a terminal.
pub(super) fn load(
    folder: &Path,
    settings: &CaptureSettings,
    global: &GlobalArgs,
) -> Result<Capture, CaptureError> {
    if global.quiet || !std::io::stderr().is_terminal() {
        return Capture::load(folder, settings);
    }
    let bar: Mutex<Option<Progress>> = Mutex::new(None);
    let lock = || bar.lock().unwrap_or_else(PoisonError::into_inner);
    let capture = Capture::load_with_progress(folder, settings, &|done, total| {
        let mut bar = lock();
        let bar = bar.get_or_insert_with(|| Progress::new(total as u64, 0, false));
        bar.update(done as u64, || "photos".to_owned());
    });
    if let Some(bar) = lock().as_mut() {
        bar.finish();
    }
    capture
}

/// True if both paths lead to the same file or folder.
pub(super) fn is_same(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}

impl PhotoArgs {
    /// The requested settings, or the defaults.
    pub(super) fn options(&self) -> CaptureSettings {
        let default = CaptureSettings::default();
        CaptureSettings {
            downscale: self.downscale.unwrap_or(default.downscale),
            images: self.images.clone(),
            cameras: self.cameras.clone(),
            split: self
                .hold_out
                .as_deref()
                .map_or(SplitRule::default(), hold_out),
            memory: self.photo_memory.map(|mebibytes| mebibytes << 20),
            ..default
        }
    }

    /// Reads a capture and prints its warnings.
    pub(super) fn open(&self, folder: &Path, global: &GlobalArgs) -> Result<Capture, Failure> {
        let capture = load(folder, &self.options(), global)?;
        for warning in &capture.warnings {
            global.say(format_args!("warning: {warning}"));
        }
        Ok(capture)
    }

    /// Says so if the run of a scene refined its cameras and others are used: the scene fits the
    /// refined ones.
    pub(super) fn warn_of_refined(&self, capture: &Path, scene: &Path, global: &GlobalArgs) {
        let refined = scene.with_file_name(CAMERAS);
        // A later run without refinement removes the files, not the folder.
        let used = self.cameras.is_some() || is_same(capture, &scene.with_file_name(UNDISTORTED));
        if !used && refined.join("cameras.bin").is_file() {
            global.say(format_args!(
                "warning: the run of {} refined its cameras, and those of the capture are used; for the refined ones add --cameras {}",
                scene.display(),
                quoted(&refined)
            ));
        }
    }

    /// Command-line words that repeat these options; empty if none were given.
    pub(super) fn words(&self) -> Vec<OsString> {
        let mut words: Vec<OsString> = Vec::new();
        if let Some(downscale) = self.downscale {
            words.extend(["--downscale".into(), downscale.to_string().into()]);
        }
        if let Some(images) = &self.images {
            words.extend(["--images".into(), images.into()]);
        }
        if let Some(cameras) = &self.cameras {
            words.extend(["--cameras".into(), cameras.into()]);
        }
        if let Some(rule) = &self.hold_out {
            words.extend(["--hold-out".into(), rule.into()]);
        }
        if let Some(memory) = self.photo_memory {
            words.extend(["--photo-memory".into(), memory.to_string().into()]);
        }
        words
    }

    /// Refuses options without effect if no capture is read.
    pub(super) fn refuse(&self, why: &str) -> Result<(), Failure> {
        match self.words().first() {
            Some(option) => Err(Failure::BadInput(format!(
                "{}: {why}; leave it out",
                option.display()
            ))),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Command {
        #[command(flatten)]
        photos: PhotoArgs,
    }

    #[test]
    fn the_words_give_the_options_again() {
        for given in [
            &["--images", "my photos", "--downscale", "3"][..],
            &["--images", "/data/photos"],
            &["--cameras", "out/run/cameras", "--hold-out", "a.jpg,b.jpg"],
            &["--downscale", "2"],
            &["--hold-out", "0", "--photo-memory", "100"],
            &["--hold-out", "a.jpg,b/c.jpg"],
            &[],
        ] {
            let parse = |words: &[OsString]| {
                let name = [OsString::from("splat")];
                Command::parse_from(name.iter().chain(words)).photos
            };
            let given: Vec<OsString> = given.iter().map(Into::into).collect();
            let photos = parse(&given);
            assert_eq!(photos.words().len(), given.len());
            assert_eq!(parse(&photos.words()).options(), photos.options());
            assert_eq!(photos.refuse("no").is_err(), !given.is_empty());
        }
    }
}
