//! A capture has no unit: the same photos in another unit give the same run.
#![cfg(feature = "cpu")]

use std::path::Path;
use std::sync::Arc;

use burn::tensor::{Device, Tensor};
use splat_data::{Capture, CaptureSettings};
use splat_model::{CameraTensors, render};
use splat_trainer::{TrainSettings, Trainer, evaluate};

/// From a micrometre to a thousand kilometres, including two that are not powers of ten.
const UNITS: [f64; 6] = [1e-6, 0.002, 0.37, 25.4, 1e3, 1e6];

/// The example capture at 118 x 79 pixels in a unit `1 / unit` times as large.
fn capture(unit: f64) -> Arc<Capture> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/data/saharov");
    let options = CaptureSettings {
        downscale: 4,
        ..CaptureSettings::default()
    };
    let mut capture = Capture::load(&folder, &options).unwrap();
    for view in &mut capture.views {
        for row in &mut view.viewmat[..3] {
            row[3] *= unit;
        }
    }
    for point in &mut capture.points {
        point.position = point.position.map(|x| x * unit);
    }
    Arc::new(capture)
}

fn trainer(capture: &Arc<Capture>, seed: u64) -> Trainer {
    let config = TrainSettings {
        steps: 200,
        seed,
        ..TrainSettings::default()
    };
    Trainer::builder(capture.clone())
        .settings(config)
        .device(Device::flex())
        .build()
        .unwrap()
}

/// `|a - b| / |b|`.
fn relative(a: &[f32], b: &[f32], factor: f64) -> f64 {
    assert_eq!(a.len(), b.len());
    let difference = |(a, b): (&f32, &f32)| (f64::from(*a) * factor - f64::from(*b)).powi(2);
    let error: f64 = a.iter().zip(b).map(difference).sum();
    let size: f64 = b.iter().map(|b| f64::from(*b).powi(2)).sum();
    (error / size).sqrt()
}

/// The first render and its gradients, as name, values, and the power of the capture's unit in
/// them.
fn first_step(unit: f64) -> Vec<(&'static str, Vec<f32>, i32)> {
    fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
        tensor.into_data().try_into_vec().unwrap()
    }
    let capture = capture(unit);
    let trainer = trainer(&capture, 0);
    let gaussians = trainer.model();
    let settings = TrainSettings::default().render_settings(0, trainer.scene_scale());
    let camera = capture.views[3].camera().relative_to(gaussians.origin);
    let camera = CameraTensors::from_camera(&camera, &gaussians.means.device());
    let image = render(&*gaussians, &camera, &settings).unwrap().image();
    let grads = (image.clone() - 0.4).square().mean().backward();
    let scales: Vec<f32> = host(gaussians.log_scales.val().exp());
    vec![
        ("scales", scales, 1),
        ("image", host(image.inner()), 0),
        ("means", host(gaussians.means.grad(&grads).unwrap()), -1),
        (
            "log_scales",
            host(gaussians.log_scales.grad(&grads).unwrap()),
            0,
        ),
        (
            "opacities",
            host(gaussians.opacity_logits.grad(&grads).unwrap()),
            0,
        ),
        ("sh0", host(gaussians.sh0.grad(&grads).unwrap()), 0),
    ]
}

/// Only rounding differs, so splats whose alpha is within rounding of a threshold may differ.
#[test]
fn the_first_render_and_its_gradients_are_the_same_in_any_unit() {
    let expected = first_step(1.0);
    assert!(expected[1].1.iter().any(|value| *value > 0.2));
    for unit in UNITS {
        for ((name, found, power), (_, expected, _)) in first_step(unit).iter().zip(&expected) {
            let error = relative(found, expected, unit.powi(-power));
            println!("unit {unit}: {name} {error:.1e}");
            assert!(error <= 1e-5, "unit {unit}: {name} differs by {error:.1e}");
        }
    }
}

#[test]
fn training_is_the_same_in_any_unit() {
    let scores = |unit: f64| -> Vec<f64> {
        let capture = capture(unit);
        let score = |seed| {
            let trained = trainer(&capture, seed).run().unwrap();
            let views: Vec<_> = capture.test_views().collect();
            let settings = &trained.render_settings;
            let device = Device::flex();
            evaluate(&trained.model, &views, settings, &device, |_, _| {})
                .unwrap()
                .psnr
        };
        [0, 1, 2].map(score).to_vec()
    };
    let mean = |scores: &[f64]| scores.iter().sum::<f64>() / scores.len() as f64;
    let expected = scores(1.0);
    let spread = expected.iter().copied().fold(f64::MIN, f64::max)
        - expected.iter().copied().fold(f64::MAX, f64::min);
    for unit in [1e-6, 0.002, 1e6] {
        let found = scores(unit);
        println!("unit {unit}: {found:.3?}, in unit 1 {expected:.3?}");
        let difference = mean(&found) - mean(&expected);
        assert!(
            difference.abs() <= spread,
            "unit {unit}: {found:.2?} dB, in unit 1 {expected:.2?}"
        );
    }
}

/// One camera of thirty is 3,000 units out.
#[test]
fn one_camera_far_out_does_not_change_the_scale() {
    let mut capture = (*capture(1.0)).clone();
    let scale = |capture: &Capture| capture.scene_scale().length();
    let before = scale(&capture);
    capture.views[7].viewmat[2][3] += 3_000.0;
    assert!((scale(&capture) / before - 1.0).abs() < 0.03);
}
