//! Scenes for tests of formats that quantise.

use super::SplatData;

/// A scene in which all values differ, within what every format holds.
pub(super) fn scene(count: usize, sh_degree: usize) -> SplatData {
    let mut next = 0.0f32;
    let mut value = |scale: f32| {
        next += 1.0;
        (next * 0.7).sin() * scale
    };
    let mut scene = SplatData {
        sh_degree,
        ..SplatData::default()
    };
    for _ in 0..count {
        scene.means.push([value(2.0), value(7.0), value(30.0)]);
        scene.log_scales.push([0; 3].map(|_| value(4.0) - 3.0));
        scene.quats.push([0; 4].map(|_| value(3.0)));
        scene.opacity_logits.push(value(4.0));
        scene.sh0.push([0; 3].map(|_| value(3.0)));
        let rest = scene.sh_rest_len();
        scene.sh_rest.extend((0..rest).map(|_| value(0.9)));
    }
    scene
}

/// Opacities of logits.
pub(super) fn opacities(scene: &SplatData) -> Vec<f32> {
    let logits = scene.opacity_logits.iter();
    logits.map(|logit| 1.0 / (1.0 + (-logit).exp())).collect()
}

/// Largest difference of two lists of equal length.
pub(super) fn difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    let all = a.iter().zip(b).map(|(a, b)| (a - b).abs());
    all.fold(0.0, f32::max)
}

/// Largest difference of the components of rotations.
pub(super) fn rotation_difference(a: &SplatData, b: &SplatData) -> f32 {
    let unit = |scene: &SplatData, index| super::values::unit_quat(scene, index);
    let of = |index| {
        let (a, b) = (unit(a, index), unit(b, index));
        // A quaternion and its negative are the same rotation.
        let dot: f64 = a.iter().zip(b).map(|(a, b)| a * b).sum();
        let all = a.iter().zip(b).map(|(a, b)| (a - dot.signum() * b).abs());
        all.fold(0.0, f64::max) as f32
    };
    (0..a.len()).map(of).fold(0.0, f32::max)
}
