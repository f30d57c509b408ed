//! A scene file on a device, with its render settings.

use std::path::Path;

use burn::tensor::Device;
use clap::ValueEnum;
use splat_data::{Capture, SceneSettings, SplatData};
use splat_model::{Gaussians, RenderSettings, ShPrecision};

use super::{Failure, GlobalArgs, text};

/// Values of `--sh-precision`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub enum PrecisionChoice {
    /// Single precision
    #[default]
    Exact,
    /// The higher degrees in half precision, on devices that support it: less memory;
    /// docs/notes/half-precision.md has the error
    Half,
}

/// Reads a scene and its render settings from its file. Files of earlier versions and of other
/// programs do not say whether the scene was trained with anti-aliasing or a background; only for
/// those, the run's `config.toml` beside the file is read, if there is one. What neither says is
/// taken from the capture that the scene is of, if there is one.
pub(super) fn open(
    path: &Path,
    capture: Option<&Capture>,
    device: &Device,
    precision: PrecisionChoice,
    global: &GlobalArgs,
) -> Result<(Gaussians, RenderSettings), Failure> {
    let data = read(path, capture, global)?;
    let mut gaussians = Gaussians::from_data(&data, device);
    if precision == PrecisionChoice::Half {
        gaussians = gaussians.with_sh_precision(ShPrecision::Half);
        if gaussians.sh_precision() == ShPrecision::Exact {
            global.say("rendering exactly: there are no higher degrees that fit half precision, or the device reads none");
        }
    }
    Ok((gaussians, RenderSettings::of_scene(&data)))
}

/// Reads a scene with its render settings, with the warnings that they need.
pub(super) fn read(
    path: &Path,
    capture: Option<&Capture>,
    global: &GlobalArgs,
) -> Result<SplatData, Failure> {
    let mut data = splat_data::scene::read(path)?;
    for what in &data.settings.not_understood {
        global.say(format_args!(
            "warning: {}: not followed: `{what}`",
            path.display()
        ));
    }
    ask_config(path, &mut data.settings, global);
    if let Some(capture) = capture {
        data.settings.complete_from(capture);
    }
    Ok(data)
}

/// Reads missing settings from the `config.toml` beside the scene. A file that does not belong to a
/// run is ignored.
fn ask_config(scene: &Path, settings: &mut SceneSettings, global: &GlobalArgs) {
    let path = scene.with_file_name("config.toml");
    let says_all = settings.antialias.is_some() && settings.background.is_some();
    if says_all || !path.is_file() {
        return;
    }
    match text::read_config(&path) {
        Ok(config) => {
            if config.antialias || config.background.is_some() {
                global.say("rendering as the config.toml beside the scene says");
            }
            settings.antialias.get_or_insert(config.antialias);
            let background = config.background.unwrap_or_default();
            settings.background.get_or_insert(background);
        }
        Err(failure) => global.say(format_args!(
            "warning: the config.toml beside the scene is not a run's settings and is passed over ({failure})"
        )),
    }
}
