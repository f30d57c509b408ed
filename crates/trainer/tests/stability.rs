//! Deliberately bad starts: a run of 500 steps ends, every parameter stays finite, and a warning
//! names the problem.
#![cfg(feature = "cpu")]

use std::path::Path;
use std::sync::{Arc, Mutex, OnceLock};

use burn::tensor::Device;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use splat_data::{Capture, CaptureSettings};
use splat_trainer::{TrainSettings, Trained, Trainer, Warning};

/// The training view that some of the tests corrupt.
const SPOILED: usize = 5;

fn load(downscale: u32) -> Capture {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/data/saharov");
    Capture::load(
        &folder,
        &CaptureSettings {
            downscale,
            ..CaptureSettings::default()
        },
    )
    .unwrap()
}

/// The example capture at 59 x 39 pixels, with a tenth of its points.
fn capture() -> Capture {
    static CAPTURE: OnceLock<Capture> = OnceLock::new();
    let mut capture = CAPTURE.get_or_init(|| load(8)).clone();
    capture.points = capture.points.into_iter().step_by(10).collect();
    capture
}

fn config() -> TrainSettings {
    TrainSettings {
        steps: 500,
        ..TrainSettings::default()
    }
}

/// Trains to the end, checks the parameters, and returns the warnings.
fn train(what: &str, capture: Capture, config: TrainSettings) -> Vec<Warning> {
    let heard = Arc::new(Mutex::new(Vec::new()));
    let hear = heard.clone();
    let steps = config.steps;
    let trained = Trainer::builder(capture)
        .settings(config)
        .device(Device::flex())
        .on_warning(move |warning| hear.lock().unwrap().push(warning.clone()))
        .build()
        .unwrap()
        .run()
        .unwrap();
    assert_eq!(trained.steps, steps);
    assert_all_finite(&trained);
    let warnings = std::mem::take(&mut *heard.lock().unwrap());
    assert_eq!(trained.history.warnings, warnings);
    let history = &trained.history;
    println!(
        "{what}: loss {:.4} -> {:.4}, {} Gaussians, {:.1} s",
        history.losses[0].total,
        history.mean_loss(50).unwrap(),
        trained.model.len(),
        trained.elapsed.as_secs_f64()
    );
    for warning in &warnings {
        println!("  warning: {warning}");
    }
    warnings
}

fn assert_all_finite(trained: &Trained) {
    let data = trained.model.to_data();
    let fields = [
        ("means", data.means.as_flattened()),
        ("log_scales", data.log_scales.as_flattened()),
        ("quats", data.quats.as_flattened()),
        ("opacity_logits", &data.opacity_logits),
        ("sh0", data.sh0.as_flattened()),
        ("sh_rest", &data.sh_rest),
    ];
    for (field, values) in fields {
        let bad = values.iter().filter(|x| !x.is_finite()).count();
        assert_eq!(bad, 0, "{bad} of {} {field} are not finite", values.len());
    }
    let losses = &trained.history.losses;
    assert_eq!(losses.len(), trained.steps, "some losses were not finite");
}

/// Changes the camera of a view, from its old world-to-camera matrix to a new one; returns the
/// view's name.
fn spoil_camera(
    capture: &mut Capture,
    change: impl Fn([[f64; 4]; 4]) -> [[f64; 4]; 4],
) -> Vec<String> {
    let view = &mut capture.views[capture.split.train[SPOILED]];
    view.viewmat = change(view.viewmat);
    vec![view.name.clone()]
}

/// The camera at another position with the same orientation.
fn moved(mut viewmat: [[f64; 4]; 4], to: [f64; 3]) -> [[f64; 4]; 4] {
    for row in &mut viewmat[..3] {
        row[3] = -(row[0] * to[0] + row[1] * to[1] + row[2] * to[2]);
    }
    viewmat
}

#[test]
fn a_good_start_gives_no_warning() {
    assert_eq!(train("good", capture(), config()), []);
    // As in `splat train`, at a quarter of the size.
    let config = TrainSettings {
        steps: 300,
        ..config()
    };
    assert_eq!(train("good, larger", load(4), config), []);
}

#[test]
fn coincident_points_are_counted() {
    let mut capture = capture();
    let place = capture.points[0].position;
    for point in &mut capture.points {
        point.position = place;
    }
    let points = capture.points.len();
    let warnings = train("coincident points", capture, config());
    let count = points - 1;
    let expected = Warning::CoincidentPoints { count, points };
    assert!(warnings.contains(&expected), "{warnings:?}");
}

#[test]
fn points_of_another_scale_than_the_cameras_are_told() {
    let mut capture = capture();
    for point in &mut capture.points {
        point.position = point.position.map(|x| x * 1e-5);
    }
    let warnings = train("shrunken points", capture, config());
    let found = |w: &Warning| matches!(w, Warning::CompactPoints { .. });
    assert!(warnings.iter().any(found), "{warnings:?}");
}

#[test]
fn huge_gaussians_are_told_with_their_setting() {
    let mut config = config();
    config.init.scale = 1000.0;
    let warnings = train("scales x 1000", capture(), config);
    let found = |w: &Warning| matches!(w, Warning::LargeGaussians { init_scale, .. } if *init_scale == 1000.0);
    assert!(warnings.iter().any(found), "{warnings:?}");
}

#[test]
fn a_camera_inside_the_points_is_named() {
    let mut capture = capture();
    let axis = |i: usize| {
        let mut values: Vec<f64> = capture.points.iter().map(|p| p.position[i]).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    let middle = [0, 1, 2].map(axis);
    let names = spoil_camera(&mut capture, |viewmat| moved(viewmat, middle));
    let warnings = train("camera inside", capture, config());
    let found =
        |w: &Warning| matches!(w, Warning::CamerasInsidePoints { views, .. } if *views == names);
    assert!(warnings.iter().any(found), "{warnings:?}");
}

#[test]
fn a_camera_far_away_is_named() {
    let mut capture = capture();
    let view = &capture.views[capture.split.train[SPOILED]];
    let place = view.camera().position() * 100.0;
    let names = spoil_camera(&mut capture, |viewmat| moved(viewmat, place.to_array()));
    let warnings = train("camera far away", capture, config());
    let found = |w: &Warning| matches!(w, Warning::CamerasFarAway { views, .. } if *views == names);
    assert!(warnings.iter().any(found), "{warnings:?}");
}

#[test]
fn a_camera_that_looks_away_is_named() {
    let mut capture = capture();
    // x and z of the camera, negated: half a turn about its vertical axis.
    let names = spoil_camera(&mut capture, |[x, y, z, w]| {
        [x.map(|v| -v), y, z.map(|v| -v), w]
    });
    let warnings = train("camera looking away", capture, config());
    let found =
        |w: &Warning| matches!(w, Warning::CamerasSeeFewPoints { views, .. } if *views == names);
    assert!(warnings.iter().any(found), "{warnings:?}");
}

/// A camera that sees the points as well as any other is detected by its loss.
#[test]
fn a_camera_upside_down_is_named() {
    let mut capture = capture();
    let names = spoil_camera(&mut capture, |[x, y, z, w]| {
        [x.map(|v| -v), y.map(|v| -v), z, w]
    });
    let warnings = train("camera upside down", capture, config());
    let found = |w: &Warning| matches!(w, Warning::HardViews { views, .. } if *views == names);
    assert!(warnings.iter().any(found), "{warnings:?}");
}

#[test]
fn photos_of_noise_are_named() {
    let mut capture = capture();
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    for view in &mut capture.views {
        let noise = (0..view.image.len()).map(|_| rng.random()).collect();
        view.image = Arc::new(noise);
    }
    let names: Vec<_> = capture.views.iter().map(|v| v.name.clone()).collect();
    let warnings = train("noise", capture, config());
    let found = |w: &Warning| matches!(w, Warning::NoisePhotos { views, .. } if *views == names);
    assert!(warnings.iter().any(found), "{warnings:?}");
}

#[test]
fn high_learning_rates_are_named_with_their_factor() {
    let mut config = config();
    let rates = &mut config.learning_rates;
    for rate in [
        &mut rates.means,
        &mut rates.scales,
        &mut rates.quats,
        &mut rates.opacities,
        &mut rates.sh0,
        &mut rates.sh_rest,
    ] {
        *rate *= 10.0;
    }
    let warnings = train("rates x 10", capture(), config);
    let found = warnings.iter().find_map(|w| match w {
        Warning::HighRates { rates } => Some(rates),
        _ => None,
    });
    let rates = found.unwrap_or_else(|| panic!("{warnings:?}"));
    assert_eq!(rates.len(), 6);
    for (name, factor) in rates {
        assert!((factor - 10.0).abs() < 1e-9, "{name}: {factor}");
    }
}

/// Black points start at the clamp of colours at zero, below which nothing learns. Colours change
/// by at most 7e-4 per step.
#[test]
fn black_points_learn_their_colours() {
    let mean_loss = |blacken: fn(usize) -> bool| {
        let mut capture = capture();
        for (index, point) in capture.points.iter_mut().enumerate() {
            if blacken(index) {
                point.color = [0; 3];
            }
        }
        let trained = Trainer::builder(capture)
            .settings(TrainSettings {
                steps: 1_500,
                ..config()
            })
            .device(Device::flex())
            .build()
            .unwrap()
            .run()
            .unwrap();
        let sh0 = trained.model.to_data().sh0;
        // A channel without any gradient stays where black starts: at level 0, or at half a level.
        let start = |level: f64| ((level / 255.0 - 0.5) / 0.282_094_791_773_878_14) as f32;
        let starts = [start(0.0), start(0.5)];
        let channels = sh0.iter().flatten();
        let stuck = channels.filter(|x| starts.contains(x)).count();
        let share = stuck as f64 / (3 * sh0.len()) as f64;
        (trained.history.mean_loss(50).unwrap(), share)
    };
    let (usual, _) = mean_loss(|_| false);
    for blacken in [(|_| true) as fn(usize) -> bool, |index| index % 10 == 0] {
        let (loss, stuck) = mean_loss(blacken);
        println!(
            "loss {loss:.4}, usually {usual:.4}; {:.1} % stuck",
            100.0 * stuck
        );
        assert!(loss < 1.3 * usual, "{loss} instead of {usual}");
        assert!(stuck < 0.02, "{:.1} % never learned", 100.0 * stuck);
    }
}

#[test]
fn an_opacity_that_nothing_could_bring_back_is_refused() {
    type Change = fn(&mut TrainSettings);
    let changes: [(&str, Change); 3] = [
        ("init.opacity", |c| c.init.opacity = 0.003),
        ("density.reset_opacity", |c| c.density.reset_opacity = 0.003),
        ("density.prune_opacity", |c| c.density.prune_opacity = 0.02),
    ];
    for (field, change) in changes {
        let mut config = config();
        change(&mut config);
        let problem = config.validate().unwrap_err();
        assert!(problem.contains(field), "{problem}");
    }
    assert_eq!(config().validate(), Ok(()));
}
