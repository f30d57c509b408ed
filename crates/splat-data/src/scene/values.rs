//! Checks of a scene's values, shared by the formats that quantise them.

use std::path::Path;

use super::{SceneFileError, SplatData};
use crate::SceneScale;

/// Checks that every value has a meaning: opacity logits may be infinite, log-scales minus infinity
/// (a flat Gaussian), everything else is finite. Properties are named as in a PLY file.
pub(super) fn check(path: &Path, scene: &SplatData) -> Result<(), SceneFileError> {
    scene.check_shape()?;
    if scene.is_empty() {
        return Err(SceneFileError::Empty {
            path: path.to_path_buf(),
        });
    }
    check_settings(path, scene)?;
    let bad = |index, property: String, value| {
        Err(SceneFileError::NotFinite {
            path: path.to_path_buf(),
            index,
            property,
            value,
        })
    };
    let not_finite = |values: &[f32]| values.iter().position(|value| !value.is_finite());
    let rest = scene.sh_rest_len();
    for index in 0..scene.len() {
        let mean = &scene.means[index];
        if let Some(at) = not_finite(mean) {
            return bad(index, ["x", "y", "z"][at].to_owned(), mean[at]);
        }
        let color = &scene.sh0[index];
        if let Some(at) = not_finite(color) {
            return bad(index, format!("f_dc_{at}"), color[at]);
        }
        let coefficients = &scene.sh_rest[index * rest..(index + 1) * rest];
        if let Some(at) = not_finite(coefficients) {
            let name = format!("f_rest_{}", (at % 3) * (rest / 3) + at / 3);
            return bad(index, name, coefficients[at]);
        }
        let logit = scene.opacity_logits[index];
        if logit.is_nan() {
            return bad(index, "opacity".to_owned(), logit);
        }
        let scales = &scene.log_scales[index];
        if let Some(at) = scales.iter().position(|scale| !(*scale < f32::INFINITY)) {
            return bad(index, format!("scale_{at}"), scales[at]);
        }
        let quat = &scene.quats[index];
        if let Some(at) = not_finite(quat) {
            return bad(index, format!("rot_{at}"), quat[at]);
        }
    }
    Ok(())
}

/// Checks that the origin and the settings of a scene are numbers that every reader accepts.
pub(super) fn check_settings(path: &Path, scene: &SplatData) -> Result<(), SceneFileError> {
    let bad = |setting, value: &dyn std::fmt::Debug, must_be| SceneFileError::Setting {
        path: path.to_path_buf(),
        setting,
        value: format!("{value:?}"),
        must_be,
    };
    let settings = &scene.settings;
    if !scene.origin.iter().all(|value| value.is_finite()) {
        return Err(bad("origin", &scene.origin, "finite"));
    }
    if let Some(scale) = settings.scene_scale.filter(|scale| !is_scale(*scale)) {
        return Err(bad("scene_scale", &scale, "from 1e-15 to 1e10"));
    }
    let finite = |color: &[f32; 3]| color.iter().all(|value| value.is_finite());
    match settings.background.filter(|color| !finite(color)) {
        Some(color) => Err(bad("background", &color, "finite")),
        None => Ok(()),
    }
}

/// True for a possible size of a scene.
pub(super) fn is_scale(scale: f64) -> bool {
    SceneScale::new(scale).is_some_and(SceneScale::is_in_range)
}

/// Opacity of a Gaussian; 0 for one that is never drawn because its quaternion is 0 or its scale
/// overflows, neither of which survives quantisation.
pub(super) fn opacity(scene: &SplatData, index: usize) -> f64 {
    let no_rotation = scene.quats[index] == [0.0; 4];
    let overflows = |scale: &f32| !scale.exp().is_finite();
    if no_rotation || scene.log_scales[index].iter().any(overflows) {
        return 0.0;
    }
    1.0 / (1.0 + (-f64::from(scene.opacity_logits[index])).exp())
}

/// The opacity logit of a byte: infinite for opacities of 0 and 1.
pub(super) fn logit(byte: u8) -> f32 {
    let opacity = f64::from(byte) / 255.0;
    (opacity / (1.0 - opacity)).ln() as f32
}

/// A Gaussian's unit quaternion (w, x, y, z); the identity for the quaternion 0.
pub(super) fn unit_quat(scene: &SplatData, index: usize) -> [f64; 4] {
    let quat = scene.quats[index].map(f64::from);
    let norm = quat.iter().map(|q| q * q).sum::<f64>().sqrt();
    match norm > 0.0 {
        true => quat.map(|q| q / norm),
        false => [1.0, 0.0, 0.0, 0.0],
    }
}

/// Index of the component of a quaternion with the largest magnitude; the first of equals.
pub(super) fn largest(quat: [f64; 4]) -> usize {
    (1..4).fold(0, |largest, at| {
        match quat[at].abs() > quat[largest].abs() {
            true => at,
            false => largest,
        }
    })
}
