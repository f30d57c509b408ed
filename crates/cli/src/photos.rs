//! Options for reading photos, shared by all commands that read a capture.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use clap::Args;

use super::{Failure, GlobalArgs};
use splat_data::{Capture, CaptureSettings};

/// Options of commands that read a capture.
#[derive(Debug, Clone, Default, Args)]
pub struct PhotoArgs {
    /// Area-average the photos by this factor [default: 1]
    #[arg(long, value_name = "K")]
    pub downscale: Option<u32>,
    /// Folder of the photos, relative to the capture or absolute [default: images]
    #[arg(long, value_name = "DIR")]
    pub images: Option<PathBuf>,
}

impl PhotoArgs {
    /// The requested settings, or the defaults.
    pub(super) fn options(&self) -> CaptureSettings {
        let default = CaptureSettings::default();
        CaptureSettings {
            downscale: self.downscale.unwrap_or(default.downscale),
            images: self.images.clone(),
        }
    }

    /// Reads a capture and prints its warnings.
    pub(super) fn open(&self, folder: &Path, global: &GlobalArgs) -> Result<Capture, Failure> {
        let capture = Capture::load(folder, &self.options())?;
        for warning in &capture.warnings {
            global.say(format_args!("warning: {warning}"));
        }
        Ok(capture)
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
            &["--downscale", "2"],
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
