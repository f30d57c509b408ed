//! Counts pixels where one rounding error more or less decides whether a splat is blended.

use super::run::Computed;
use super::scene::Scene;

/// Relative distance to a threshold that counts as near.
const NEAR: f64 = 1e-6;

/// Pixels, over all cameras, where some alpha or transmittance lies within one part in a million
/// of the threshold it is compared with.
///
/// Every splat against every pixel, in double precision, from the screen splats of the check.
pub fn count_near_thresholds(scene: &Scene, computed: &Computed) -> usize {
    let n = scene.gaussians;
    if n == 0 {
        return 0;
    }
    let (width, height) = (scene.size.width, scene.size.height);
    let cameras = computed.projected.values.chunks_exact(9 * n);
    let opacities = computed.opacities.values.chunks_exact(n);
    cameras
        .zip(opacities)
        .map(|(packed, opacities)| {
            let mut splats: Vec<_> = packed
                .chunks_exact(9)
                .zip(opacities)
                .filter(|(row, _)| row[7] > 0.0) // culled splats have no extent
                .collect();
            splats.sort_by(|(a, _), (b, _)| a[2].total_cmp(&b[2])); // stable: ties by index
            let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
            pixels
                .filter(|(x, y)| is_near(scene, &splats, f64::from(*x) + 0.5, f64::from(*y) + 0.5))
                .count()
        })
        .sum()
}

fn is_near(scene: &Scene, splats: &[(&[f64], &f64)], x: f64, y: f64) -> bool {
    let settings = &scene.rasterize;
    let near = |value: f64, threshold: f64| (value - threshold).abs() <= NEAR * threshold;
    let mut transmittance = 1.0;
    for (row, opacity) in splats {
        let (dx, dy) = (x - row[0], y - row[1]);
        let (z1, z2) = (row[3] * dx, row[4] * dx + row[5] * dy);
        let alpha_raw = *opacity * (-(z1 * z1 + z2 * z2) / 2.0).exp();
        if near(alpha_raw, settings.alpha_min) || near(alpha_raw, settings.alpha_max) {
            return true;
        }
        if alpha_raw < settings.alpha_min {
            continue;
        }
        let left = transmittance * (1.0 - alpha_raw.min(settings.alpha_max));
        if near(left, settings.transmittance_min) {
            return true;
        }
        if left < settings.transmittance_min {
            return false;
        }
        transmittance = left;
    }
    false
}
