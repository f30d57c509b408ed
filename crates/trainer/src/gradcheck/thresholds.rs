//! Walks every pixel of a scene splat by splat: counts the work, and the pixels where one rounding error more or less
//! decides whether a splat is blended.

use super::run::Computed;
use super::scene::Scene;

/// Relative distance to a threshold that counts as near.
pub const NEAR: f64 = 1e-6;

/// What a walk over all pixels of all cameras counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Walk {
    /// Pixels where some alpha or transmittance lies near the threshold it is compared with.
    pub near_threshold: usize,
    /// (Pixel, splat) pairs with an alpha of at least `alpha_min`, up to where the pixel stops.
    pub seen: u64,
    /// Those of them that were blended.
    pub blended: u64,
}

/// Walks every splat against every pixel, in double precision, from the screen splats of `computed`. A value within
/// `near` of a threshold, relatively, is near it.
pub fn walk(scene: &Scene, computed: &Computed, near: f64) -> Walk {
    let n = scene.gaussians;
    let mut total = Walk::default();
    if n == 0 {
        return total;
    }
    let cameras = computed.projected.values.chunks_exact(9 * n);
    let opacities = computed.opacities.values.chunks_exact(n);
    for (packed, opacities) in cameras.zip(opacities) {
        let mut splats: Vec<_> = packed
            .chunks_exact(9)
            .zip(opacities)
            .filter(|(row, _)| row[7] > 0.0) // culled splats have no extent
            .collect();
        splats.sort_by(|(a, _), (b, _)| a[2].total_cmp(&b[2])); // stable: ties by index
        for y in 0..scene.size.height {
            for x in 0..scene.size.width {
                let pixel = walk_pixel(
                    scene,
                    &splats,
                    [f64::from(x) + 0.5, f64::from(y) + 0.5],
                    near,
                );
                total.near_threshold += pixel.near_threshold;
                total.seen += pixel.seen;
                total.blended += pixel.blended;
            }
        }
    }
    total
}

fn walk_pixel(scene: &Scene, splats: &[(&[f64], &f64)], [x, y]: [f64; 2], near: f64) -> Walk {
    let settings = &scene.rasterize;
    let mut pixel = Walk::default();
    let mut touch = |value: f64, threshold: f64| {
        if (value - threshold).abs() <= near * threshold {
            pixel.near_threshold = 1;
        }
    };
    let (mut seen, mut blended) = (0, 0);
    let mut transmittance = 1.0;
    for (row, opacity) in splats {
        let (dx, dy) = (x - row[0], y - row[1]);
        let (z1, z2) = (row[3] * dx, row[4] * dx + row[5] * dy);
        let alpha_raw = *opacity * (-(z1 * z1 + z2 * z2) / 2.0).exp();
        touch(alpha_raw, settings.alpha_min);
        touch(alpha_raw, settings.alpha_max);
        if !(alpha_raw >= settings.alpha_min) {
            continue;
        }
        seen += 1;
        let left = transmittance * (1.0 - alpha_raw.min(settings.alpha_max));
        touch(left, settings.transmittance_min);
        if left < settings.transmittance_min {
            break;
        }
        blended += 1;
        transmittance = left;
    }
    pixel.seen = seen;
    pixel.blended = blended;
    pixel
}
