//! The backward pass makes the same decision about every (pixel, splat) pair as the forward pass,
//! even within a few units in the last place of a threshold: 1,075,200 pairs.
//!
//! Splats so wide that alpha differs by only a few units over a tile lie on the threshold. Each has
//! its own camera with an image of one tile. Every pixel has an integer gradient, so the sum over
//! the pixels that count as blended can be read from the splat's gradient, and the same sum over
//! lit pixels from the image.

use burn::tensor::{Device, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::devices;
use crate::{ImageSize, Projected, RasterizeSettings, rasterize};

const CAMERAS: usize = 1400;
const SIDE: usize = 16;
const PIXELS: usize = SIDE * SIDE;

/// The image `[C, PIXELS]` of the only channel, and the gradients `[C, N]` of colours and
/// opacities.
struct Outcome {
    image: Vec<f32>,
    colors: Vec<f32>,
    opacities: Vec<f32>,
}

/// Renders one tile per camera through `opacities` `[C, N]`; only the last splat of each camera has
/// a colour.
fn render(
    device: &Device,
    opacities: &[f32],
    weights: &[f32],
    settings: &RasterizeSettings,
) -> Outcome {
    let device = device.clone().autodiff();
    let n = opacities.len() / CAMERAS;
    let mut rng = Pcg32::seed_from_u64(50);
    let mut packed = Vec::new();
    for _ in 0..CAMERAS {
        for depth in 1..=n {
            let mut w = || rng.random_range(1e-5f32..5e-5);
            let (w11, w21, w22) = (w(), w(), w());
            let mut mean = || rng.random_range(4.0f32..12.0);
            let (x, y) = (mean(), mean());
            packed.extend([x, y, depth as f32, w11, w21, w22, 1.0, 1e5, 1e5]);
        }
    }
    let colors = (0..CAMERAS * n).map(|i| if i % n == n - 1 { 1.0f32 } else { 0.0 });
    let data = |values: Vec<f32>, shape: [usize; 3]| TensorData::new(values, shape);
    let at = |values, shape| Tensor::<3>::from_data(data(values, shape), &device);

    let size = ImageSize {
        width: SIDE as u32,
        height: SIDE as u32,
    };
    let projected = Projected::from_packed(at(packed, [CAMERAS, n, 9]), size).unwrap();
    let colors = at(colors.collect(), [CAMERAS, n, 1]).require_grad();
    let opacities = at(opacities.to_vec(), [CAMERAS, n, 1]).require_grad();
    let image = rasterize(
        &projected,
        colors.clone(),
        opacities.clone().squeeze_dim::<2>(2),
        None,
        settings,
    )
    .unwrap()
    .image();
    let weights = at(weights.to_vec(), [CAMERAS, PIXELS, 1]);
    let loss = (image.clone().reshape([CAMERAS, PIXELS, 1]) * weights).sum();
    let grads = loss.backward();
    let to_host = |data: TensorData| data.try_to_vec::<f32>().unwrap();
    Outcome {
        image: to_host(image.into_data()),
        colors: to_host(colors.grad(&grads).unwrap().into_data()),
        opacities: to_host(opacities.grad(&grads).unwrap().into_data()),
    }
}

/// Whole numbers from 1 to 16, one per pixel.
fn weights() -> Vec<f32> {
    let mut rng = Pcg32::seed_from_u64(51);
    let weights = (0..CAMERAS * PIXELS).map(|_| rng.random_range(1..=16u8));
    weights.map(f32::from).collect()
}

/// `value` and the next values up to `reach` units in the last place above it, one per camera.
fn around(value: f32, reach: u32) -> impl Iterator<Item = f32> {
    let mut rng = Pcg32::seed_from_u64(52);
    (0..CAMERAS).map(move |_| f32::from_bits(value.to_bits() + rng.random_range(0..=reach)))
}

/// For each camera, compares the summed weights of the pixels that `chosen` picks by value with the
/// backward pass; both outcomes must be frequent.
fn check(
    name: &str,
    image: &[f32],
    weights: &[f32],
    chosen: impl Fn(f32) -> bool,
    backward: impl Fn(usize) -> f32,
) {
    let mut picked = 0;
    for camera in 0..CAMERAS {
        let pixels = camera * PIXELS..(camera + 1) * PIXELS;
        let mut sum = 0.0f32;
        for (value, weight) in image[pixels.clone()].iter().zip(&weights[pixels]) {
            if chosen(*value) {
                sum += weight;
                picked += 1;
            }
        }
        let found = backward(camera);
        assert!(
            (found - sum).abs() < 0.05,
            "{name}, camera {camera}: forward {sum}, backward {found}"
        );
    }
    let share = picked as f64 / (CAMERAS * PIXELS) as f64;
    println!("{name}: {:.0} % picked", 100.0 * share);
    assert!((0.1..0.9).contains(&share), "{name}: {share}");
}

#[test]
fn backward_skips_what_forward_skipped() {
    let settings = RasterizeSettings::default();
    let alpha_min = settings.alpha_min as f32;
    let opacities: Vec<f32> = around(alpha_min, 2).collect();
    let weights = weights();
    for (name, device) in devices() {
        let outcome = render(&device, &opacities, &weights, &settings);
        check(
            &format!("{name}: blended"),
            &outcome.image,
            &weights,
            |value| value > 0.0,
            |camera| outcome.colors[camera] / alpha_min,
        );
    }
}

#[test]
fn backward_caps_what_forward_capped() {
    let settings = RasterizeSettings::default();
    let alpha_max = settings.alpha_max as f32;
    let opacities: Vec<f32> = around(alpha_max, 2).collect();
    let weights = weights();
    for (name, device) in devices() {
        let outcome = render(&device, &opacities, &weights, &settings);
        // The splat is the first, with colour 1: the image equals alpha, and the gradient of alpha
        // the weight.
        check(
            &format!("{name}: below the cap"),
            &outcome.image,
            &weights,
            |value| value < alpha_max,
            |camera| outcome.opacities[camera],
        );
    }
}

#[test]
fn backward_stops_where_forward_stopped() {
    // Half of the light passes the first splat, and half of that the second: within a few units of
    // the stop.
    let settings = RasterizeSettings {
        transmittance_min: 0.25,
        ..Default::default()
    };
    let opacities: Vec<f32> = around(0.5, 4).flat_map(|o| [0.5, o]).collect();
    let weights = weights();
    for (name, device) in devices() {
        let outcome = render(&device, &opacities, &weights, &settings);
        check(
            &format!("{name}: not stopped"),
            &outcome.image,
            &weights,
            |value| value > 0.0,
            |camera| outcome.colors[2 * camera + 1] / 0.25,
        );
    }
}
