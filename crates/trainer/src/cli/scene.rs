//! A scene file on a device, and how to render it.

use std::path::Path;

use burn::tensor::Device;
use clap::ValueEnum;
use splat_model::files::ply;
use splat_model::ops::SH_DEGREE_MAX;
use splat_model::{Gaussians, RenderSettings, SceneScale, ShPrecision};

use super::{Failure, GlobalArgs};
use crate::train::TrainConfig;

/// What has more bytes is no file of settings, and reading it as one could take all memory.
const LONGEST_CONFIG: usize = 1 << 20;

/// What `--sh-precision` takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub enum PrecisionChoice {
    /// Single precision
    #[default]
    Exact,
    /// The higher degrees in half precision, on devices that read it: less memory; docs/GPU.md has the error
    Half,
}

/// Reads a scene. Scene files do not say whether they were trained with anti-aliasing or in front of a background;
/// where the run's `config.toml` lies beside the file, it does.
pub(super) fn open(
    path: &Path,
    device: &Device,
    precision: PrecisionChoice,
    global: &GlobalArgs,
) -> Result<(Gaussians, RenderSettings), Failure> {
    let data = ply::read(path)?;
    let scene = SceneScale::of_splats(&data);
    let mut settings = RenderSettings {
        sh_degree: SH_DEGREE_MAX,
        project: scene.project_settings(),
        ..RenderSettings::default()
    };
    let config = path.with_file_name("config.toml");
    if config.is_file() {
        let config: TrainConfig = read_config(&config)?;
        settings = config.render_settings(SH_DEGREE_MAX, scene);
        if config.antialias || config.background.is_some() {
            global.say("rendering as the config.toml beside the scene says");
        }
    }
    let mut gaussians = Gaussians::from_data(&data, device);
    if precision == PrecisionChoice::Half {
        gaussians = gaussians.with_sh_precision(ShPrecision::Half);
        if gaussians.sh_precision() == ShPrecision::Exact {
            global.say("rendering exactly: there are no higher degrees that fit half precision, or the device reads none");
        }
    }
    Ok((gaussians, settings))
}

/// Reads a run's settings.
pub(super) fn read_config(path: &Path) -> Result<TrainConfig, Failure> {
    let bytes = std::fs::read(path).map_err(|error| unusable(path, &error))?;
    parse_config(path, &bytes)
}

/// [`read_config`] on the content of a file; `path` is for messages.
pub(crate) fn parse_config(path: &Path, bytes: &[u8]) -> Result<TrainConfig, Failure> {
    if bytes.len() > LONGEST_CONFIG {
        let reason = format!(
            "{} bytes; the settings of a run take a few hundred",
            bytes.len()
        );
        return Err(unusable(path, &reason));
    }
    let text = std::str::from_utf8(bytes).map_err(|error| unusable(path, &error))?;
    toml::from_str(text).map_err(|error| unusable(path, &error))
}

/// A file and why it cannot be used, in one line.
fn unusable(path: &Path, reason: &dyn std::fmt::Display) -> Failure {
    let reason = reason.to_string();
    let words: Vec<_> = reason.split_whitespace().collect();
    Failure::BadInput(format!("{}: {}", path.display(), words.join(" ")))
}
