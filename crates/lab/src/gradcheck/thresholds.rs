//! Walks every pixel of a scene splat by splat, counting the work and the pixels where one rounding
//! error decides whether a splat is blended.

use super::rounding;
use super::run::Computed;
use super::scene::Scene;

/// Relative distance that counts as near a threshold.
pub const NEAR: f64 = 1e-6;

/// Counts of a walk over all pixels of all cameras.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Walk {
    /// Pixels where some alpha or transmittance is near its threshold.
    pub near_threshold: usize,
    /// (Pixel, splat) pairs with an alpha of at least `alpha_min`, up to the stop of the pixel.
    pub seen: u64,
    /// Pairs that were blended.
    pub blended: u64,
}

/// Walks every splat at every pixel, in double precision, from the screen splats of `computed`. A
/// value within a relative `near` of a threshold counts as near it.
pub fn walk(scene: &Scene, computed: &Computed, near: f64) -> Walk {
    let mut total = Walk::default();
    walk_pixels(scene, computed, Margin::Relative(near), |_, pixel| {
        total.near_threshold += usize::from(pixel.near);
        total.seen += pixel.seen;
        total.blended += pixel.blended;
    });
    total
}

/// Pixels that single precision may decide differently, as indices into `[C, H, W]`: an alpha or a
/// transmittance of `computed`, which is in double precision, lies within rounding of a threshold
/// there.
pub fn near_in_single(scene: &Scene, computed: &Computed) -> Vec<usize> {
    let mut found = vec![];
    walk_pixels(scene, computed, Margin::Single, |index, pixel| {
        if pixel.near {
            found.push(index);
        }
    });
    found
}

/// Criterion for being near a threshold.
#[derive(Clone, Copy)]
enum Margin {
    /// By relative distance.
    Relative(f64),
    /// Within the rounding of single precision.
    Single,
}

impl Margin {
    /// True if a value known up to `error` in single precision is near a threshold.
    fn holds(self, value: f64, error: f64, threshold: f64) -> bool {
        match self {
            Self::Relative(near) => (value - threshold).abs() <= near * threshold,
            Self::Single => {
                let (decided, rounded) = (value >= threshold, f64::from(threshold as f32));
                [value - error, value + error]
                    .into_iter()
                    .any(|value| (value >= rounded) != decided)
            }
        }
    }
}

/// A splat on the screen of one camera.
struct ScreenSplat<'a> {
    /// In the layout of [`Projected::packed`](splat_ops::Projected::packed).
    row: &'a [f64],
    opacity: f64,
    /// Error of the screen mean in single precision.
    mean_error: [f64; 2],
}

/// State of one pixel.
#[derive(Default)]
struct Pixel {
    near: bool,
    seen: u64,
    blended: u64,
}

fn walk_pixels(
    scene: &Scene,
    computed: &Computed,
    margin: Margin,
    mut visit: impl FnMut(usize, Pixel),
) {
    let n = scene.gaussians;
    if n == 0 {
        return;
    }
    let cameras = computed.projected.values.chunks_exact(9 * n);
    let opacities = computed.opacities.values.chunks_exact(n);
    let views = scene.inputs.viewmat.values.chunks_exact(16);
    let intrinsics = scene.inputs.intrinsics.values.chunks_exact(4);
    let mut index = 0;
    for ((((packed, opacities), view), intrinsics), lens) in cameras
        .zip(opacities)
        .zip(views)
        .zip(intrinsics)
        .zip(scene.lenses())
    {
        let rows = packed.chunks_exact(9).zip(opacities);
        let mut splats: Vec<_> = rows
            .zip(scene.inputs.means.values.chunks_exact(3))
            .filter(|((row, _), _)| row[7] > 0.0) // culled splats have no extent
            .map(|((row, opacity), mean)| ScreenSplat {
                row,
                opacity: *opacity,
                mean_error: rounding::screen_mean(mean, view, intrinsics, &lens),
            })
            .collect();
        splats.sort_by(|a, b| a.row[2].total_cmp(&b.row[2])); // stable: ties by index
        for y in 0..scene.size.height {
            for x in 0..scene.size.width {
                let centre = [f64::from(x) + 0.5, f64::from(y) + 0.5];
                visit(index, walk_pixel(scene, &splats, centre, margin));
                index += 1;
            }
        }
    }
}

fn walk_pixel(scene: &Scene, splats: &[ScreenSplat], [x, y]: [f64; 2], margin: Margin) -> Pixel {
    let settings = &scene.rasterize;
    let cap_error = (f64::from(settings.alpha_max as f32) - settings.alpha_max).abs();
    let mut pixel = Pixel::default();
    let mut transmittance = (1.0, 0.0);
    for splat in splats {
        let row = splat.row;
        let (dx, dy) = (x - row[0], y - row[1]);
        let (z1, z2) = (row[3] * dx, row[4] * dx + row[5] * dy);
        let alpha_raw = splat.opacity * (-(z1 * z1 + z2 * z2) / 2.0).exp();
        let factor = [row[3], row[4], row[5]];
        let error = rounding::alpha(
            alpha_raw,
            [dx, dy],
            factor,
            splat.mean_error,
            scene.antialias,
        );
        pixel.near |= margin.holds(alpha_raw, error, settings.alpha_min)
            || margin.holds(alpha_raw, error, settings.alpha_max);
        if !(alpha_raw >= settings.alpha_min) {
            continue;
        }
        pixel.seen += 1;
        let (alpha, error) = if alpha_raw >= settings.alpha_max {
            (settings.alpha_max, cap_error)
        } else {
            (alpha_raw, error)
        };
        let left = rounding::behind(transmittance, alpha, error);
        pixel.near |= margin.holds(left.0, left.1, settings.transmittance_min);
        if left.0 < settings.transmittance_min {
            break;
        }
        pixel.blended += 1;
        transmittance = left;
    }
    pixel
}
