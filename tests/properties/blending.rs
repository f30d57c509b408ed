//! Properties of the rasteriser's colours, alpha and transmittance.

use burn::tensor::DType;
use burn_splat::ops::{Projected, RasterizeSettings, rasterize};
use proptest::collection::vec;
use proptest::prelude::*;

use super::scene::{PIXELS, SIZE, Scene, Upload, host, scenes, thresholds};
use super::support::{close, config, identical, weights};

/// An image of D channels, and the gradients of a weighted sum over it.
struct Blended {
    /// `[H, W, D]`.
    image: Vec<f64>,
    /// `[H, W]`.
    alpha: Vec<f64>,
    /// `[N, 9]`.
    packed: Vec<f64>,
    /// `[N, D]`.
    colors: Vec<f64>,
    /// `[N]`.
    opacities: Vec<f64>,
    /// `[D]`.
    background: Vec<f64>,
}

/// `weights` are those of the loss, `[H, W, D + 1]`.
fn blend(
    scene: &Scene,
    colors: &[f64],
    background: &[f64],
    weights: &[f64],
    settings: &RasterizeSettings,
    dtype: DType,
) -> Blended {
    let to = Upload { dtype };
    let (n, d) = (scene.len(), background.len());
    let packed = scene.project(dtype).packed().require_grad();
    let projected = Projected::from_packed(packed.clone(), SIZE).expect("shapes fit");
    let colors = to.leaf::<2>(colors, [n, d]);
    let opacities = to.leaf::<1>(&scene.opacities, [n]);
    let background = to.leaf::<2>(background, [1, d]);
    let rendered = rasterize(
        &projected,
        colors.clone(),
        opacities.clone(),
        Some(background.clone()),
        settings,
    )
    .expect("shapes fit");
    let loss = (rendered.packed() * to.constant(weights, [1, 24, 40, d + 1])).sum();
    let grads = loss.backward();
    Blended {
        image: host(rendered.image()),
        alpha: host(rendered.alpha()),
        packed: host(packed.grad(&grads).expect("tracked")),
        colors: host(colors.grad(&grads).expect("tracked")),
        opacities: host(opacities.grad(&grads).expect("tracked")),
        background: host(background.grad(&grads).expect("tracked")),
    }
}

/// Alpha only, `[H, W]`, independent of colours.
fn alpha(scene: &Scene, settings: &RasterizeSettings, dtype: DType) -> Vec<f64> {
    let colors = vec![1.0; scene.len()];
    blend(
        scene,
        &colors,
        &[0.0],
        &weights(PIXELS * 2),
        settings,
        dtype,
    )
    .alpha
}

/// A scene, with features for its Gaussians and the background, `[N + 1, channels]`.
fn with_features(channels: usize) -> impl Strategy<Value = (Scene, Vec<f64>)> {
    scenes(1..=12).prop_flat_map(move |scene| {
        let features = vec(-1.0..1.0, (scene.len() + 1) * channels);
        (Just(scene), features)
    })
}

/// Channels `range` of rows of `width` channels.
fn channels(values: &[f64], width: usize, range: core::ops::Range<usize>) -> Vec<f64> {
    values
        .chunks_exact(width)
        .flat_map(|row| &row[range.clone()])
        .copied()
        .collect()
}

proptest! {
    #![proptest_config(config(48))]

    /// Channels are independent: rendered in two batches, each has the same bits, and so has its
    /// gradient; gradients of shared inputs add up.
    #[test]
    fn splitting_channels_changes_no_bit((scene, features) in with_features(5), cut in 1..5usize) {
        let settings = RasterizeSettings::default();
        let n = scene.len();
        let upstream = weights(PIXELS * 6);
        let batch = |range: core::ops::Range<usize>, alpha: f64, dtype: DType| {
            let features = channels(&features, 5, range.clone());
            let (colors, background) = features.split_at(n * range.len());
            let upstream: Vec<f64> = upstream
                .chunks_exact(6)
                .flat_map(|row| row[range.clone()].iter().copied().chain([row[5] * alpha]))
                .collect();
            blend(&scene, colors, background, &upstream, &settings, dtype)
        };
        let (whole, left, right) = (
            batch(0..5, 1.0, DType::F32),
            batch(0..cut, 1.0, DType::F32),
            batch(cut..5, 0.0, DType::F32),
        );
        for (part, range) in [(&left, 0..cut), (&right, cut..5)] {
            identical("image", &part.image, &channels(&whole.image, 5, range.clone()))?;
            identical("alpha", &part.alpha, &whole.alpha)?;
            identical("colors", &part.colors, &channels(&whole.colors, 5, range.clone()))?;
            identical("background", &part.background, &channels(&whole.background, 5, range))?;
        }

        let (whole, left, right) = (
            batch(0..5, 1.0, DType::F64),
            batch(0..cut, 1.0, DType::F64),
            batch(cut..5, 0.0, DType::F64),
        );
        let sum = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a + b).collect::<Vec<_>>();
        close("packed", &sum(&left.packed, &right.packed), &whole.packed, 1e-11)?;
        close("opacities", &sum(&left.opacities, &right.opacities), &whole.opacities, 1e-11)?;
    }

    /// The image of `a c + b c'` is a times that of c plus b times that of c', with the background
    /// as one more colour.
    #[test]
    fn the_image_is_linear_in_colours(
        (scene, features) in with_features(6),
        a in -3.0..3.0f64,
        b in -3.0..3.0f64,
    ) {
        let settings = RasterizeSettings::default();
        let image = |features: &[f64]| {
            let (colors, background) = features.split_at(scene.len() * 3);
            blend(&scene, colors, background, &weights(PIXELS * 4), &settings, DType::F64).image
        };
        let (first, second) = (channels(&features, 6, 0..3), channels(&features, 6, 3..6));
        let mix = |x: &[f64], y: &[f64]| {
            x.iter().zip(y).map(|(x, y)| a * x + b * y).collect::<Vec<_>>()
        };
        let expected = mix(&image(&first), &image(&second));
        let size = expected.iter().fold(1.0, |m: f64, v| m.max(v.abs()));
        for (got, expected) in image(&mix(&first, &second)).iter().zip(expected) {
            prop_assert!((got - expected).abs() <= 1e-14 * size, "{got} and {expected}");
        }
    }

    /// The weights of splats and background are non-negative and sum to 1; the background's is 1 -
    /// alpha.
    #[test]
    fn the_background_gets_what_alpha_leaves((scene, features) in with_features(1)) {
        let settings = RasterizeSettings::default();
        let (colors, background) = features.split_at(scene.len());
        let image = |colors: &[f64], background: f64| {
            blend(&scene, colors, &[background], &weights(PIXELS * 2), &settings, DType::F64)
        };
        let without = image(colors, 0.0);
        let with = image(colors, background[0]);
        identical("alpha", &with.alpha, &without.alpha)?;
        for i in 0..PIXELS {
            let expected = without.image[i] + (1.0 - without.alpha[i]) * background[0];
            prop_assert!((with.image[i] - expected).abs() <= 1e-15, "{} and {expected}", with.image[i]);
        }
        let ones = image(&vec![1.0; scene.len()], 1.0);
        for value in ones.image {
            prop_assert!((value - 1.0).abs() <= 1e-14, "the weights sum to {value}");
        }
    }

    /// In both precisions, and never more than the stop allows.
    #[test]
    fn alpha_stays_between_0_and_1(
        scene in scenes(1..=30),
        opaque: bool,
        settings in thresholds(),
    ) {
        let scene = Scene {
            opacities: scene.opacities.iter().map(|o| if opaque { 1.0 } else { *o }).collect(),
            ..scene
        };
        for (dtype, rounding) in [(DType::F32, 1e-7), (DType::F64, 1e-15)] {
            for value in alpha(&scene, &settings, dtype) {
                let highest = 1.0 - settings.transmittance_min + rounding;
                prop_assert!((0.0..=highest).contains(&value), "alpha {value} in {dtype:?}");
            }
        }
    }

    /// An additional splat, anywhere in the order, does not increase the light at any pixel, to the
    /// last bit of single precision.
    ///
    /// With the early stop this holds only for a splat behind all others. In front, a pixel may
    /// stop before a splat that it blended otherwise; but then at most `transmittance_min / (1 -
    /// alpha_max)` of light is left.
    #[test]
    fn one_more_splat_lets_no_more_light_through(
        scene in scenes(2..=10),
        which: prop::sample::Index,
        stop in thresholds(),
    ) {
        let which = which.index(scene.len());
        let depths = host(scene.project(DType::F64).depths());
        let behind = depths.iter().all(|depth| *depth <= depths[which]);
        let fewer = without(&scene, which);
        let no_stop = RasterizeSettings { transmittance_min: 0.0, ..stop };
        let opaque = 1.0 - stop.transmittance_min / (1.0 - stop.alpha_max);
        for dtype in [DType::F32, DType::F64] {
            let compared = |settings| alpha(&scene, settings, dtype)
                .into_iter()
                .zip(alpha(&fewer, settings, dtype))
                .collect::<Vec<_>>();
            for (more, less) in compared(&no_stop) {
                prop_assert!(more >= less, "{more} < {less} in {dtype:?}");
            }
            for (more, less) in compared(&stop) {
                prop_assert!(
                    more >= less || (!behind && more >= opaque - 1e-6),
                    "{more} < {less} in {dtype:?}, with the stop"
                );
            }
        }
    }
}

/// The scene without its Gaussian `which`.
fn without(scene: &Scene, which: usize) -> Scene {
    let drop = |values: &[f64]| {
        let width = values.len() / scene.len();
        let mut values = values.to_vec();
        values.drain(which * width..(which + 1) * width);
        values
    };
    Scene {
        means: drop(&scene.means),
        quats: drop(&scene.quats),
        scales: drop(&scene.scales),
        opacities: drop(&scene.opacities),
        coeffs: drop(&scene.coeffs),
        ..scene.clone()
    }
}
