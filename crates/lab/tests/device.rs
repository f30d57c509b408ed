//! Training on a CubeCL device: reproducible bits, and the documented memory. A process of its own
//! with serialised tests, as the allocator's count is process-wide.
#![cfg(all(feature = "cpu", feature = "wgpu"))]

use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use burn::tensor::Device;
use splat_data::{Capture, CaptureSettings};
use splat_lab::performance::scaling::{PhotoSize, synthetic_capture};
use splat_lab::performance::{PER_GAUSSIAN_AT_REST, device_step};
use splat_ops::device::kernel_work;
use splat_test_support::adapter_or_skip;
use splat_trainer::{TrainSettings, Trained, Trainer};

static ALONE: Mutex<()> = Mutex::new(());

/// wgpu's adapter, a software one included. Prints a message and returns `None` if there is none.
fn adapter() -> Option<(MutexGuard<'static, ()>, Device)> {
    static ADAPTER: std::sync::OnceLock<Option<Device>> = std::sync::OnceLock::new();
    let guard = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    // A process can open the device only once.
    let device = ADAPTER.get_or_init(|| adapter_or_skip(Device::wgpu_options().init()));
    Some((guard, device.clone()?))
}

const STEPS: usize = 24;

/// The example capture at 20 x 30 pixels, with one point in forty.
fn capture() -> Arc<Capture> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/data/saharov");
    let mut capture = Capture::load(
        &folder,
        &CaptureSettings {
            downscale: 16,
            ..CaptureSettings::default()
        },
    )
    .unwrap();
    capture.points = capture.points.into_iter().step_by(40).collect();
    Arc::new(capture)
}

/// A run with refinements at steps 8 and 12, and a reset of opacities.
fn train(capture: &Arc<Capture>, device: &Device, seed: u64) -> Trained {
    train_with(capture, device, seed, true)
}

fn train_with(capture: &Arc<Capture>, device: &Device, seed: u64, deterministic: bool) -> Trained {
    let mut config = TrainSettings {
        steps: STEPS,
        seed,
        deterministic,
        ..TrainSettings::default()
    };
    config.density.every = 4;
    config.density.reset_every = 8;
    config.density.grow_gradient = Some(1e-5);
    // More than the default for such small photos.
    config.density.max_gaussians = Some(10_000);
    Trainer::builder(capture.clone())
        .settings(config)
        .device(device.clone())
        .build()
        .unwrap()
        .run()
        .unwrap()
}

/// Every parameter of every Gaussian and every loss, as bits.
fn bits(trained: &Trained) -> Vec<(&'static str, Vec<u32>)> {
    let data = trained.model.to_data();
    let losses: Vec<f32> = trained.history.losses.iter().map(|r| r.total).collect();
    [
        ("means", data.means.as_flattened()),
        ("log_scales", data.log_scales.as_flattened()),
        ("quats", data.quats.as_flattened()),
        ("opacity_logits", &data.opacity_logits),
        ("sh0", data.sh0.as_flattened()),
        ("sh_rest", &data.sh_rest),
        ("losses", &losses),
    ]
    .map(|(name, values)| (name, values.iter().map(|v| v.to_bits()).collect()))
    .into()
}

#[test]
fn ten_runs_of_one_seed_leave_the_same_bits() {
    let Some((_alone, device)) = adapter() else {
        return;
    };
    let capture = capture();
    let first = train(&capture, &device, 7);
    let counts = &first.history.counts;
    println!("Gaussians: {counts:?}, a run took {:?}", first.elapsed);
    assert!(
        counts.windows(2).any(|pair| pair[1].1 > pair[0].1),
        "density control added nothing: {counts:?}"
    );
    assert_eq!(first.history.losses.len(), STEPS);
    let expected = bits(&first);
    for run in 2..=10 {
        for ((name, ours), (_, expected)) in
            bits(&train(&capture, &device, 7)).iter().zip(&expected)
        {
            assert_eq!(ours.len(), expected.len(), "run {run}: number of {name}");
            let differ = ours.iter().zip(expected).filter(|(a, b)| a != b).count();
            assert_eq!(
                differ,
                0,
                "run {run}: so many of {} {name} differ",
                ours.len()
            );
        }
    }
    // Checks the comparison itself: another seed gives other bits.
    assert_ne!(bits(&train(&capture, &device, 8)), expected);
}

#[test]
fn gradients_without_order_train_alike_with_less_memory() {
    let Some((_alone, device)) = adapter() else {
        return;
    };
    let capture = capture();
    // The room reserved for lists depends on earlier lists.
    train(&capture, &device, 7);
    let [ordered, unordered] = [true, false].map(|deterministic| {
        let before = kernel_work();
        let trained = train_with(&capture, &device, 7, deterministic);
        let losses: Vec<f32> = trained.history.losses.iter().map(|r| r.total).collect();
        (losses, kernel_work().since(before).reserved_bytes)
    });
    // Until the first refinement, whose thresholds any last digit may cross.
    let (mut most, until) = (0.0f32, 8);
    for (a, b) in unordered.0[..until].iter().zip(&ordered.0[..until]) {
        most = most.max((a - b).abs() / b);
    }
    println!(
        "losses differ by {most:e}, bytes {unordered:?} and {ordered:?}",
        unordered = unordered.1,
        ordered = ordered.1
    );
    assert!(most < 1e-4, "{most}");
    assert!(unordered.1 < ordered.1);
}

#[test]
fn the_state_between_steps_takes_the_bytes_that_are_stated() {
    let Some((_alone, device)) = adapter() else {
        return;
    };
    let config = TrainSettings::default();
    let [small, large] = [1500, 4500].map(|gaussians| {
        let capture = Arc::new(synthetic_capture(gaussians, PhotoSize::of_pixels(3072)));
        let report = device_step::measure(&capture, &config, &device, 0.0, |_| {}).unwrap();
        for row in &report.rows {
            assert!(row.launches > 10.0 && row.waits >= 1.0 && row.intersections > 100.0);
            assert!(row.share_of_floor > 0.0 && row.share_of_floor < 1.0);
            assert!(row.reserved_bytes > row.intersections);
        }
        let [_, row] = &report.rows[..] else { panic!() };
        assert_eq!(row.sh_degree, 3);
        row.memory
    });
    assert_eq!([small.gaussians, large.gaussians], [1500, 4500]);
    let growth = |of: fn(&splat_lab::performance::DeviceMemory) -> u64| {
        (of(&large) as f64 - of(&small) as f64) / 3000.0
    };
    let (at_rest, most) = (growth(|m| m.at_rest_bytes), growth(|m| m.most_bytes));
    println!("{small:?}\n{large:?}\nper Gaussian: {at_rest} at rest, {most} in a step");
    // Nothing else grows with the Gaussians; a few bytes of alignment are ignored.
    assert!((at_rest / PER_GAUSSIAN_AT_REST as f64 - 1.0).abs() < 0.01);
    // A step adds gradients (236 bytes), projected splats (36), colours, and the state kept for
    // them.
    assert!(most > at_rest + 236.0, "{most}");
}
