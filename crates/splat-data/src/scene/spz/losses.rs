//! What a file cannot hold of a scene.

use super::super::SplatData;
use super::fields::{MOST_COLOR, scale_fits};
use super::positions::{Grid, farthest};

/// Coarsest step of the positions that is not worth a warning, in scene scales.
const COARSE: f64 = 1e-4;

/// What is lost beyond precision, one line each.
pub(super) fn losses(scene: &SplatData) -> Vec<String> {
    let mut losses = Vec::new();
    let settings = &scene.settings;
    if let Some(scale) = settings.scene_scale {
        losses.push(format!("the scene scale {scale} is left out"));
    }
    // Without a background, scenes are drawn on black.
    let background = settings.background.filter(|color| *color != [0.0; 3]);
    if let Some([r, g, b]) = background {
        losses.push(format!("the background {r} {g} {b} is left out"));
    }
    if scene.origin != [0.0; 3] {
        losses.push("the origin is added to the positions".to_owned());
    }
    let (index, reach) = farthest(scene);
    let step = Grid::finest(reach).map(Grid::step);
    if let Some(step) = step.filter(|step| *step > COARSE * scene.scene_scale().length()) {
        losses.push(format!(
            "positions are rounded to {step}, because Gaussian {index} lies at {reach}"
        ));
    }
    let scales = scene.log_scales.as_flattened().iter();
    let scales = scales.filter(|scale| scale.is_finite() && !scale_fits(**scale));
    let colors = scene.sh0.as_flattened().iter();
    let colors = colors.filter(|value| f64::from(value.abs()) > MOST_COLOR);
    let harmonics = scene.sh_rest.iter().filter(|value| value.abs() > 1.0);
    let clamped = [
        (scales.count(), "scale(s) are clamped to e^-10 to e^5.9"),
        (colors.count(), "value(s) of sh0 are clamped to -3.3 to 3.3"),
        (
            harmonics.count(),
            "value(s) of sh_rest are clamped to -1 to 1",
        ),
    ];
    let clamped = clamped.into_iter().filter(|(count, _)| *count > 0);
    losses.extend(clamped.map(|(count, what)| format!("{count} {what}")));
    losses
}
