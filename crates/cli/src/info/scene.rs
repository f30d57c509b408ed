//! Description of a scene.

use std::fmt::Write;
use std::path::Path;

use splat_data::SplatData;

use super::histogram::histogram;
use super::{bounds, bounds_text};

/// Opacity below which a Gaussian is never drawn, see `RasterizeSettings`.
const ALPHA_MIN: f64 = 1.0 / 255.0;

/// Describes the scene read from `path`.
pub(super) fn describe(path: &Path, scene: &SplatData) -> String {
    let opacities = || {
        let logits = scene.opacity_logits.iter();
        logits.map(|&logit| 1.0 / (1.0 + (-f64::from(logit)).exp()))
    };
    let largest = scene.log_scales.iter().map(|scales| {
        let scales = scales.map(f64::from);
        scales[0].max(scales[1]).max(scales[2]) / std::f64::consts::LN_10
    });
    let positions = || {
        let means = scene.means.iter().map(|mean| mean.map(f64::from));
        means.map(|mean| std::array::from_fn(|axis| scene.origin[axis] + mean[axis]))
    };

    let mut text = format!("scene {}\n", path.display());
    let _ = writeln!(text, "Gaussians  {}", scene.len());
    let _ = writeln!(text, "SH degree  {}", scene.sh_degree);
    if scene.origin != [0.0; 3] {
        let [x, y, z] = scene.origin;
        let _ = writeln!(text, "origin  {x} {y} {z}");
    }
    let settings = &scene.settings;
    if let Some(scale) = settings.scene_scale {
        let _ = writeln!(text, "scene scale  {scale}");
    }
    if let Some(antialias) = settings.antialias {
        let _ = writeln!(
            text,
            "anti-aliasing  {}",
            if antialias { "on" } else { "off" }
        );
    }
    if let Some([r, g, b]) = settings.background {
        let _ = writeln!(text, "background  {r} {g} {b}");
    }
    let _ = write!(text, "bounds\n{}", bounds_text(bounds(positions())));
    let _ = write!(
        text,
        "bounds of the middle 98 % of each axis\n{}",
        bounds_text(middle(positions().collect()))
    );
    let _ = write!(text, "opacity\n{}", histogram(opacities(), 0.0, 1.0, 10));
    let (least, most) = whole_range(largest.clone());
    let bins = ((most - least) * 2.0).clamp(1.0, 24.0) as usize;
    let _ = write!(
        text,
        "largest scale, log10\n{}",
        histogram(largest, least, most, bins)
    );
    for warning in warnings(scene, opacities()) {
        let _ = writeln!(text, "warning: {warning}");
    }
    text
}

/// Warnings about the scene.
fn warnings(scene: &SplatData, opacities: impl Iterator<Item = f64>) -> Vec<String> {
    let no_rotation = |quat: &&[f32; 4]| quat.iter().all(|&q| q == 0.0);
    let overflows = |scales: &&[f32; 3]| scales.iter().any(|s| !s.exp().is_finite());
    let counted = [
        (
            opacities.filter(|&opacity| opacity < ALPHA_MIN).count(),
            "have an opacity below 1/255 and are never drawn",
        ),
        (
            scene.quats.iter().filter(no_rotation).count(),
            "have the quaternion 0 and are never drawn",
        ),
        (
            scene.log_scales.iter().filter(overflows).count(),
            "have a scale that 32-bit floats cannot hold and are never drawn",
        ),
    ];
    let counted = counted.into_iter().filter(|(count, _)| *count > 0);
    let counted = counted.map(|(count, what)| format!("{count} Gaussian(s) {what}"));
    let foreign = scene.settings.not_understood.iter();
    let foreign = foreign.map(|what| format!("not followed: `{what}`"));
    counted.chain(foreign).collect()
}

/// Range of each axis without its lowest and highest hundredth, which are far outliers in most
/// scenes.
pub(super) fn middle(positions: Vec<[f64; 3]>) -> [[f64; 2]; 3] {
    std::array::from_fn(|axis| {
        let mut values: Vec<f64> = positions.iter().map(|position| position[axis]).collect();
        values.sort_by(f64::total_cmp);
        let last = values.len().saturating_sub(1);
        let at = |share: f64| values.get((share * last as f64).round() as usize);
        [0.01, 0.99].map(|share| at(share).copied().unwrap_or(f64::NAN))
    })
}

/// Range of the finite `values`, widened to whole numbers; the log-scale of a flat Gaussian is
/// minus infinity.
fn whole_range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let range = values
        .filter(|value| value.is_finite())
        .fold(None, |range, value| {
            let (least, most) = range.unwrap_or((value, value));
            Some((value.min(least), value.max(most)))
        });
    let (least, most) = range.unwrap_or((0.0, 0.0));
    let least = least.floor();
    (least, most.ceil().max(least + 1.0))
}

#[cfg(test)]
mod tests {
    use splat_data::SceneSettings;

    use super::*;

    #[test]
    fn a_scene_is_described() {
        let scene = SplatData {
            means: vec![[0.0, -1.0, 2.0], [4.0, 1.0, 2.5]],
            log_scales: vec![[-4.0; 3], [0.0, 1.0, 99.0]],
            quats: vec![[0.0; 4], [1.0, 0.0, 0.0, 0.0]],
            opacity_logits: vec![-9.0, 3.0],
            sh0: vec![[0.0; 3]; 2],
            sh_rest: vec![0.0; 18],
            sh_degree: 1,
            settings: SceneSettings {
                scene_scale: Some(2.5),
                antialias: Some(true),
                background: Some([0.0, 0.5, 1.0]),
                not_understood: vec!["SplatRenderMode: 2dgs".into()],
            },
            ..SplatData::default()
        };
        let text = describe(Path::new("a.ply"), &scene);
        // Flat Gaussians are counted, but do not affect the range.
        assert_eq!(
            whole_range([f64::NEG_INFINITY, -1.5, 2.5].into_iter()),
            (-2.0, 3.0)
        );
        assert_eq!(whole_range([f64::NEG_INFINITY].into_iter()), (0.0, 1.0));
        for line in [
            "Gaussians  2",
            "SH degree  1",
            "scene scale  2.5",
            "anti-aliasing  on",
            "background  0 0.5 1",
            "warning: not followed: `SplatRenderMode: 2dgs`",
            "  y  -1.0000 to 1.0000",
            "warning: 1 Gaussian(s) have an opacity below 1/255",
            "warning: 1 Gaussian(s) have the quaternion 0",
            "warning: 1 Gaussian(s) have a scale",
        ] {
            assert!(text.contains(line), "no `{line}` in\n{text}");
        }
    }
}
