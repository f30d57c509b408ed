//! Fixtures on a threshold that single and double precision decide differently.

use super::*;
use crate::accuracy::{Sketch, neighbours};
use crate::gradcheck::{Scene, gate};

/// The threshold that the last splat of a scene reaches at [`PIXEL`].
#[derive(Debug, Clone, Copy)]
enum On {
    /// Its alpha to `alpha_min`.
    Cut,
    /// Its alpha to `alpha_max`.
    Cap,
    /// The transmittance behind it to `transmittance_min`.
    Stop,
}

const PIXEL: [f64; 2] = [3.5, 4.5];

/// A few splats, and behind two of them at the pixel one whose opacity is found later.
fn sketch(on: On, side: u32, seed: u64) -> Scene {
    let mut sketch = Sketch::new("threshold", side, side, seed);
    if let On::Stop = on {
        sketch.rasterize.transmittance_min = 0.05;
    }
    sketch.scatter(4, (0.1, 0.3));
    let place =
        |sketch: &mut Sketch, reach: f64| PIXEL.map(|at| at + reach * sketch.uniform(0.5, 1.0));
    if let On::Stop = on {
        for depth in [7.0, 8.0] {
            let at = place(&mut sketch, 0.5);
            sketch.splat(at, depth, [2.0; 3], [1.0, 0.0, 0.0, 0.0], 0.6);
        }
    }
    let reach = if let On::Cut = on { 3.0 } else { 0.2 };
    let at = place(&mut sketch, reach);
    let depth = if let On::Cap = on { 1.5 } else { 9.0 };
    sketch.splat(at, depth, [3.0, 2.5, 2.0], [1.0, 0.1, 0.2, 0.3], 0.5);
    sketch.scene()
}

fn double(scene: &Scene) -> crate::gradcheck::Computed {
    run(scene, &Device::flex(), Precision::F64, None).unwrap()
}

/// The fixture of a scene from our own double precision, and whether single precision fails it with
/// every pixel counted.
fn judged_whole(scene: Scene) -> (Fixture, bool) {
    let reference = double(&scene);
    let fixture = Fixture {
        case: String::new(),
        hard: false,
        expected: reference.outputs,
        gradients: reference.gradients,
        absgrad: reference.absgrad,
        scene,
    };
    let single = run(&fixture.scene, &Device::flex(), Precision::F32, None).unwrap();
    let report = compare(&fixture, &single, Precision::F32, 0);
    (fixture, !report.pass)
}

/// Alpha of the last splat at the pixel in double precision, for an opacity of 1, and the
/// transmittance before it.
fn at_pixel(scene: &Scene) -> (f64, f64) {
    let computed = double(scene);
    let falloffs = computed.projected.values.chunks_exact(9).map(|row| {
        let (dx, dy) = (PIXEL[0] - row[0], PIXEL[1] - row[1]);
        let (z1, z2) = (row[3] * dx, row[4] * dx + row[5] * dy);
        (-(z1 * z1 + z2 * z2) / 2.0).exp()
    });
    let falloffs: Vec<f64> = falloffs.collect();
    let (last, others) = falloffs.split_last().unwrap();
    let alphas = others.iter().zip(&scene.inputs.opacities.values);
    let before = alphas
        .map(|(falloff, opacity)| falloff * opacity)
        .filter(|alpha| *alpha >= scene.rasterize.alpha_min)
        .map(|alpha| 1.0 - alpha)
        .product();
    (*last, before)
}

/// A fixture on a threshold that single precision fails with every pixel counted.
fn on_threshold(on: On, side: u32) -> Fixture {
    for seed in 0..50 {
        let mut scene = sketch(on, side, seed);
        let (falloff, before) = at_pixel(&scene);
        let settings = &scene.rasterize;
        let alpha = match on {
            On::Cut => settings.alpha_min,
            On::Cap => settings.alpha_max,
            On::Stop => 1.0 - settings.transmittance_min / before,
        };
        let mut opacity = f64::from((alpha / falloff) as f32);
        if !(opacity > 0.0 && opacity < 1.0) {
            continue;
        }
        for _ in 0..4 {
            opacity = neighbours(opacity)[0];
        }
        for _ in 0..8 {
            let last = scene.gaussians - 1;
            scene.inputs.opacities.values[last] = opacity;
            if let (fixture, true) = judged_whole(scene.clone()) {
                return fixture;
            }
            opacity = neighbours(opacity)[1];
        }
    }
    panic!("single precision decides like double precision everywhere");
}

fn checked(fixture: &Fixture, bug: Option<Bug>) -> FileReport {
    check(fixture, &Device::flex(), bug).unwrap()
}

/// Far from the principal point, where a screen mean is the difference of large numbers, single
/// precision decides several pixels differently. An extra or missing splat shows in the image.
#[test]
fn every_pixel_that_single_precision_decides_differently_is_near() {
    let (mut flipped, mut near, mut pixels) = (0, 0, 0);
    for seed in 0..40 {
        let mut sketch = Sketch::new("off-centre", 32, 32, seed).tilted();
        sketch.intrinsics = [2048.0, 2048.0, -3000.0, 1500.0];
        sketch.project.clamp_margin = 1e3;
        sketch.scatter(60, (0.05, 0.5));
        let scene = sketch.scene();
        let exact = double(&scene);
        let single = run(&scene, &Device::flex(), Precision::F32, None).unwrap();
        let found = near_in_single(&scene, &exact);
        near += found.len();
        let pictures = exact.outputs.image.values.chunks_exact(3);
        let pictures = pictures.zip(single.outputs.image.values.chunks_exact(3));
        for (pixel, (exact, single)) in pictures.enumerate() {
            pixels += 1;
            let worst = exact.iter().zip(single).map(|(a, b)| (a - b).abs());
            if worst.fold(0.0, f64::max) > 2e-4 {
                flipped += 1;
                assert!(found.contains(&pixel), "seed {seed}, pixel {pixel}");
            }
        }
    }
    println!("{flipped} decided differently, {near} near, of {pixels}");
    assert!(
        flipped >= 5,
        "{flipped} decided differently, {near} near, of {pixels}"
    );
    assert!(near < pixels / 10, "{near} near of {pixels}");
}

#[test]
fn a_pixel_on_a_threshold_is_left_out_and_the_rest_holds() {
    for on in [On::Cut, On::Cap, On::Stop] {
        let fixture = on_threshold(on, 24);
        let report = checked(&fixture, None);
        assert!(report.pass, "{on:?}: {report:#?}");
        assert_eq!(report.gate, gate(Precision::F32, false));
        assert!(
            (1..=5).contains(&report.near_threshold),
            "{on:?}: {report:#?}"
        );
        assert_eq!(report.pixels, 24 * 24);
        let text = crate::gradcheck::table(&[report]);
        assert!(
            text.contains("of 576 pixels near a threshold, left out"),
            "{text}"
        );
    }
}

#[test]
fn more_than_a_hundredth_of_the_pixels_on_a_threshold_fails() {
    for on in [On::Cut, On::Cap, On::Stop] {
        let fixture = on_threshold(on, 9);
        let report = checked(&fixture, None);
        assert!(!report.pass, "{on:?}: {report:#?}");
        assert!(report.failed().is_empty(), "{on:?}: {report:#?}");
        let [reason] = &report.reasons[..] else {
            panic!("{on:?}: {report:#?}");
        };
        assert!(reason.contains("more than 1 % of the pixels"), "{reason}");
    }
}

/// Excluding pixels must not excuse errors: the file is judged in double precision with all of
/// them.
#[test]
fn a_wrong_file_with_a_pixel_on_a_threshold_fails() {
    let fixture = on_threshold(On::Cut, 24);
    let mut wrong = fixture.clone();
    wrong.gradients.scales.values[4] *= 1.0 + 1e-6;
    let report = checked(&wrong, None);
    assert!(!report.pass);
    assert!(
        report.reasons[0].contains("does not match the file: scales"),
        "{report:#?}"
    );

    let pixel = near_in_single(&fixture.scene, &double(&fixture.scene))[0];
    let mut wrong = fixture.clone();
    wrong.expected.image.values[3 * pixel] += 1e-3;
    let report = checked(&wrong, None);
    assert!(!report.pass);
    assert!(
        report.reasons[0].contains("does not match the file: image"),
        "{report:#?}"
    );
}

#[test]
fn a_wrong_gradient_of_ours_with_a_pixel_on_a_threshold_fails() {
    for on in [On::Cut, On::Cap, On::Stop] {
        let fixture = on_threshold(on, 24);
        for bug in [Bug::OffDiagonalHalved, Bug::DirectionDetached] {
            let report = checked(&fixture, Some(bug));
            assert!(!report.pass && report.near_threshold > 0, "{on:?}, {bug:?}");
            assert!(
                report.failed().contains(&"means"),
                "{on:?}, {bug:?}: {report:#?}"
            );
        }
    }
}
