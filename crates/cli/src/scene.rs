//! A scene file on a device, with its render settings.

use std::path::Path;

use burn::tensor::Device;
use clap::ValueEnum;
use splat_data::{SceneSettings, SplatData};
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

/// Puts a scene on a device, with its render settings.
pub(super) fn on_device(
    data: &SplatData,
    device: &Device,
    precision: PrecisionChoice,
    global: &GlobalArgs,
) -> (Gaussians, RenderSettings) {
    let mut gaussians = Gaussians::from_data(data, device);
    if precision == PrecisionChoice::Half {
        gaussians = gaussians.with_sh_precision(ShPrecision::Half);
        if gaussians.sh_precision() == ShPrecision::Exact {
            global.say("rendering exactly: there are no higher degrees that fit half precision, or the device reads none");
        }
    }
    (gaussians, RenderSettings::of_scene(data))
}

/// Reads a scene with its render settings, with the warnings that they need. Files of earlier
/// versions and of other programs do not say whether the scene was trained with anti-aliasing or a
/// background; only for those, the run's `config.toml` beside the file is read, if there is one.
/// What neither says, [`SceneSettings::complete_from`] takes from a capture.
pub(super) fn read(path: &Path, global: &GlobalArgs) -> Result<SplatData, Failure> {
    let mut data = splat_data::scene::read(path)?;
    for what in &data.settings.not_understood {
        global.say(format_args!(
            "warning: {}: not followed: `{what}`",
            path.display()
        ));
    }
    ask_config(path, &mut data.settings, global);
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
            // One that is not in the settings may be that of the capture.
            settings.background = settings.background.or(config.background);
        }
        Err(failure) => global.say(format_args!(
            "warning: the config.toml beside the scene is not a run's settings and is passed over ({failure})"
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::DeviceChoice;
    use splat_trainer::TrainSettings;

    #[test]
    fn settings_of_a_run_say_what_the_file_does_not() {
        let folder = tempfile::tempdir().unwrap();
        let beside = |config: &TrainSettings| {
            let text = toml::to_string(config).unwrap();
            std::fs::write(folder.path().join("config.toml"), text).unwrap();
            let mut settings = SceneSettings::default();
            let global = GlobalArgs {
                device: DeviceChoice::Cpu,
                seed: None,
                quiet: true,
            };
            ask_config(&folder.path().join("scene.spz"), &mut settings, &global);
            (settings.antialias, settings.background)
        };
        // The background of a Blender capture is in no settings, and is not black for that.
        assert_eq!(beside(&TrainSettings::new()), (Some(false), None));
        let mut config = TrainSettings::new().with_antialias(true);
        config.background = Some([0.25; 3]);
        assert_eq!(beside(&config), (Some(true), Some([0.25; 3])));
    }
}
