//! Scene settings in the comments of a PLY header: the origin of the means, and how to render them.
//!
//! ```text
//! comment burn-splat origin X Y Z
//! comment burn-splat scene_scale S
//! comment burn-splat antialias 0|1
//! comment burn-splat background R G B
//! ```
//!
//! Comments are free text, so ours begin with a unique word and all others are ignored. The
//! exceptions are tags of other programs, `SplatRenderMode: default|mip|2dgs` and `antialiased
//! 0|1`, which are written too, and `origin X Y Z` with three finite numbers, the form of earlier
//! versions.
//!
//! A comment with our word and a known setting must be readable; guessing would render something
//! else. Unknown settings, perhaps of a later version, are collected in
//! [`SceneSettings::not_understood`].

use std::path::Path;
use std::str::FromStr;

use super::super::values::{check_settings, is_scale};
use super::super::{SceneFileError, SceneSettings, SplatData};

/// First word of our comments.
const OURS: &str = "burn-splat";

/// Comments of a scene, without the word `comment`.
pub(super) fn write(path: &Path, scene: &SplatData) -> Result<Vec<String>, SceneFileError> {
    check_settings(path, scene)?;
    let mut comments = Vec::new();
    let [x, y, z] = scene.origin;
    if scene.origin != [0.0; 3] {
        comments.push(format!("{OURS} origin {x} {y} {z}"));
    }
    let settings = &scene.settings;
    if let Some(scale) = settings.scene_scale {
        comments.push(format!("{OURS} scene_scale {scale:e}"));
    }
    if let Some(antialias) = settings.antialias {
        let bit = u8::from(antialias);
        let mode = if antialias { "mip" } else { "default" };
        comments.push(format!("{OURS} antialias {bit}"));
        comments.push(format!("SplatRenderMode: {mode}"));
        comments.push(format!("antialiased {bit}"));
    }
    if let Some([r, g, b]) = settings.background {
        comments.push(format!("{OURS} background {r} {g} {b}"));
    }
    Ok(comments)
}

/// Origin and settings from the comments.
pub(super) fn read(
    path: &Path,
    comments: &[String],
) -> Result<([f64; 3], SceneSettings), SceneFileError> {
    let mut found = Found::default();
    let mut foreign = Found::default();
    let mut settings = SceneSettings::default();
    for comment in comments {
        let words: Vec<&str> = comment.split_whitespace().collect();
        let known = match words.as_slice() {
            [OURS, name, values @ ..] => found.ours(name, values),
            [OURS] => Ok(true),
            words => foreign.others(words),
        };
        match known {
            Ok(true) => {}
            Ok(false) => settings.not_understood.push(words.join(" ")),
            Err(reason) => {
                return Err(SceneFileError::Header {
                    path: path.to_path_buf(),
                    reason: format!("comment `{}`: {reason}", words.join(" ")),
                });
            }
        }
    }
    settings.scene_scale = found.scene_scale;
    settings.antialias = found.antialias.or(foreign.antialias);
    settings.background = found.background;
    let origin = found.origin.or(foreign.origin);
    Ok((origin.unwrap_or_default(), settings))
}

/// Settings read so far.
#[derive(Default)]
struct Found {
    origin: Option<[f64; 3]>,
    scene_scale: Option<f64>,
    antialias: Option<bool>,
    background: Option<[f32; 3]>,
}

impl Found {
    /// Reads one of our comments: returns whether it is understood, or why it is invalid.
    fn ours(&mut self, name: &str, values: &[&str]) -> Result<bool, String> {
        match name {
            "origin" => {
                let three = numbers::<f64, 3>(values).filter(|v| v.iter().all(|x| x.is_finite()));
                set(&mut self.origin, three.ok_or("not three finite numbers")?)?;
            }
            "scene_scale" => {
                let scale = numbers::<f64, 1>(values).map(|[scale]| scale);
                let scale = scale.filter(|scale| is_scale(*scale));
                set(
                    &mut self.scene_scale,
                    scale.ok_or("not one number from 1e-15 to 1e10")?,
                )?;
            }
            "antialias" => set(&mut self.antialias, bit(values).ok_or("neither 0 nor 1")?)?,
            "background" => {
                let three = numbers::<f32, 3>(values).filter(|v| v.iter().all(|x| x.is_finite()));
                set(
                    &mut self.background,
                    three.ok_or("not three finite numbers")?,
                )?;
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// Reads a comment of other programs or earlier versions; anything else is free text.
    fn others(&mut self, words: &[&str]) -> Result<bool, String> {
        match words {
            // If two programs disagree, the first comment wins, and the second is reported.
            ["SplatRenderMode:", mode] => {
                return Ok(match *mode {
                    "default" => set(&mut self.antialias, false).is_ok(),
                    "mip" => set(&mut self.antialias, true).is_ok(),
                    _ => false,
                });
            }
            ["antialiased", value] => {
                let value = bit(&[*value]);
                return Ok(value.is_none_or(|value| set(&mut self.antialias, value).is_ok()));
            }
            ["origin", values @ ..] if values.len() == 3 => {
                let read = values.iter().filter_map(|value| value.parse::<f64>().ok());
                match read.filter(|value| value.is_finite()).count() {
                    3 => set(&mut self.origin, numbers(values).unwrap_or_default())?,
                    0 => {}
                    // Neither free text nor an origin.
                    _ => return Ok(false),
                }
            }
            _ => {}
        }
        Ok(true)
    }
}

/// Sets a value that is unset or equal.
fn set<T: PartialEq>(place: &mut Option<T>, value: T) -> Result<(), String> {
    match place {
        Some(other) if *other != value => {
            Err("another comment says something else; remove one of them".into())
        }
        _ => {
            *place = Some(value);
            Ok(())
        }
    }
}

fn numbers<T: FromStr, const N: usize>(words: &[&str]) -> Option<[T; N]> {
    let values: Option<Vec<T>> = words.iter().map(|word| word.parse().ok()).collect();
    values?.try_into().ok()
}

fn bit(words: &[&str]) -> Option<bool> {
    match words {
        ["0"] => Some(false),
        ["1"] => Some(true),
        _ => None,
    }
}
