//! Runs that refine their cameras, and masks.

use glam::{DMat4, DVec3};
use splat_data::{Lens, Observation};
use splat_model::Camera;

use super::*;
use crate::calibration::{CalibrationSettings, RefineIntrinsics, RefinePoses, align_pose};

fn settings() -> TrainSettings {
    let calibration = CalibrationSettings::new()
        .with_poses(true)
        .with_intrinsics(true);
    TrainSettings::new()
        .with_steps(120)
        .with_calibration(calibration)
}

fn run(steps: Option<usize>, resume: Option<Checkpoint>) -> Trained {
    let mut builder = builder().settings(settings());
    if let Some(checkpoint) = resume {
        builder = builder.resume(checkpoint);
    }
    if let Some(steps) = steps {
        let stop = Arc::new(AtomicBool::new(false));
        let seen = stop.clone();
        builder = builder.interrupt(stop).on_progress(move |progress| {
            seen.store(progress.step >= steps, Ordering::Relaxed);
        });
    }
    builder.build().unwrap().run().unwrap()
}

#[test]
fn refined_cameras_resume_exactly() {
    let whole = run(None, None);
    let half = run(Some(110), None);
    assert_eq!(half.steps, 110);
    let resumed = run(None, Some(half.checkpoint().unwrap()));
    let capture = capture();
    let cameras = whole.cameras(&capture).unwrap();
    assert_eq!(resumed.cameras(&capture).unwrap(), cameras);
    assert_eq!(resumed.model.to_data().means, whole.model.to_data().means);

    let before: Vec<Camera> = capture.views.iter().map(|view| view.camera()).collect();
    for (index, (after, before)) in cameras.iter().zip(&before).enumerate() {
        // A pinhole gets a lens; held-out views share it, but keep their poses.
        assert!(matches!(after.lens, Lens::OpenCv(k) if k[0] != 0.0 && k[4] == 0.0));
        assert_ne!(after.intrinsics, before.intrinsics);
        let moved = after.viewmat != before.viewmat;
        assert_eq!(moved, capture.split.train.contains(&index));
    }
}

#[test]
fn nothing_is_refined_that_was_not_asked_for() {
    let trained = builder()
        .settings(TrainSettings::new().with_steps(2))
        .build()
        .unwrap()
        .run()
        .unwrap();
    assert!(trained.hook::<RefinePoses>().is_none());
    assert!(trained.hook::<RefineIntrinsics>().is_none());
    let capture = capture();
    let before: Vec<Camera> = capture.views.iter().map(|view| view.camera()).collect();
    assert_eq!(trained.cameras(&capture).unwrap(), before);
}

/// The capture with keypoints at which its photos show its points, and every training pose turned
/// by a degree.
fn turned_with_keypoints() -> Capture {
    let mut turned = Capture::clone(&capture());
    for (view, seen) in turned.views.iter().enumerate() {
        let [fx, fy, cx, cy] = seen.intrinsics;
        for (point, there) in turned.points.iter().enumerate().step_by(40) {
            if let Some(([x, y], _)) = seen.project(there.position) {
                turned.observations.push(Observation {
                    view: view as u32,
                    point: point as u32,
                    position: [(x - cx) / fx, (y - cy) / fy],
                });
            }
        }
    }
    let turn = DMat4::from_axis_angle(DVec3::new(1.0, -2.0, 1.0).normalize(), 1f64.to_radians());
    for view in turned.split.train.clone() {
        let view = &mut turned.views[view];
        let camera = view.camera();
        *view = view.with_pose(&Camera {
            viewmat: turn * camera.viewmat,
            ..camera
        });
    }
    turned
}

/// Largest angle between poses of training views and those of the capture, in degrees.
fn largest_turn(trained: &Trained, turned: &Capture) -> f64 {
    let truth = capture();
    let cameras = trained.cameras(turned).unwrap();
    let angle = |index: &usize| {
        let before = truth.views[*index].camera().viewmat;
        let turn = glam::DMat3::from_mat4(cameras[*index].viewmat * before.inverse());
        (glam::DQuat::from_mat3(&turn).to_axis_angle().1).to_degrees()
    };
    turned.split.train.iter().map(angle).fold(0.0, f64::max)
}

#[test]
fn poses_begin_where_the_keypoints_are() {
    let turned = Arc::new(turned_with_keypoints());
    let run = |bundle: bool, stop: Option<usize>, resume: Option<Checkpoint>| {
        let fresh = resume.is_none();
        let calibration = CalibrationSettings::new()
            .with_poses(true)
            .with_bundle_adjustment(bundle);
        let settings = TrainSettings::new()
            .with_steps(8)
            .with_calibration(calibration);
        let mut builder = builder_on(turned.clone()).settings(settings);
        if let Some(checkpoint) = resume {
            builder = builder.resume(checkpoint);
        }
        if let Some(stop) = stop {
            let flag = Arc::new(AtomicBool::new(false));
            let seen = flag.clone();
            builder = builder.interrupt(flag).on_progress(move |progress| {
                seen.store(progress.step >= stop, Ordering::Relaxed);
            });
        }
        let trainer = builder.build().unwrap();
        let adjusted = trainer.bundle_adjustment().cloned();
        assert_eq!(adjusted.is_some(), bundle && fresh);
        assert!(adjusted.is_none_or(|adjusted| adjusted.fits));
        trainer.run().unwrap()
    };
    let trained = run(true, None, None);
    let (with, without) = (
        largest_turn(&trained, &turned),
        largest_turn(&run(false, None, None), &turned),
    );
    assert!(with < 0.01, "{with}");
    assert!(without > 0.8, "{without}");
    // A run that goes on has the poses of its checkpoint, and their rate.
    let half = run(true, Some(5), None);
    assert_eq!(half.steps, 5);
    let resumed = run(true, None, Some(half.checkpoint().unwrap()));
    let cameras = |trained: &Trained| trained.cameras(&turned).unwrap();
    assert_eq!(cameras(&resumed), cameras(&trained));
    assert_eq!(resumed.model.to_data().means, trained.model.to_data().means);
}

/// Views that were not adjusted have their way still to go.
#[test]
fn poses_are_fast_unless_all_were_adjusted() {
    let moved = |keep: &dyn Fn(u32) -> bool, intrinsics: bool| {
        let mut turned = turned_with_keypoints();
        turned
            .observations
            .retain(|observation| keep(observation.view));
        let calibration = CalibrationSettings::new()
            .with_poses(true)
            .with_intrinsics(intrinsics);
        let settings = TrainSettings::new()
            .with_steps(8)
            .with_calibration(calibration);
        let turned = Arc::new(turned);
        let trainer = builder_on(turned.clone())
            .settings(settings)
            .build()
            .unwrap();
        let adjusted = trainer.bundle_adjustment().unwrap().clone();
        let cameras = trainer.run().unwrap().cameras(&turned).unwrap();
        let off = |(index, before): (&usize, &DMat4)| {
            let off = (cameras[*index].viewmat - *before).to_cols_array();
            off.iter().fold(0.0, |most: f64, x| most.max(x.abs()))
        };
        let views = turned.split.train.iter().zip(&adjusted.viewmats);
        views.map(off).fold(0.0, f64::max)
    };
    let first = capture().split.train[0] as u32;
    let slow = moved(&|_| true, false);
    let (left_out, with_lens) = (moved(&|view| view != first, false), moved(&|_| true, true));
    assert!(
        slow < 1e-4 && left_out > 1e-3 && with_lens > 1e-3,
        "{slow} {left_out} {with_lens}"
    );
}

/// One step of a run that refines poses.
fn refining_poses() -> TrainSettings {
    TrainSettings::new()
        .with_steps(1)
        .with_calibration(CalibrationSettings::new().with_poses(true))
}

#[test]
fn too_few_keypoints_are_said() {
    let mut turned = turned_with_keypoints();
    turned.observations.truncate(20);
    let settings = refining_poses();
    let warnings = Arc::new(Mutex::new(Vec::new()));
    let said = warnings.clone();
    let trainer = builder_on(Arc::new(turned))
        .settings(settings)
        .on_warning(move |warning| said.lock().unwrap().push(warning.clone()))
        .build()
        .unwrap();
    assert!(trainer.bundle_adjustment().is_none());
    assert_eq!(*warnings.lock().unwrap(), [Warning::TooFewKeypoints]);
}

/// Poses that were adjusted in part would be those of another run.
#[test]
fn an_adjustment_that_is_interrupted_is_no_run() {
    let settings = refining_poses();
    let mut without = turned_with_keypoints();
    without.observations.clear();
    for capture in [turned_with_keypoints(), without] {
        let built = builder_on(Arc::new(capture))
            .settings(settings.clone())
            .interrupt(Arc::new(AtomicBool::new(true)))
            .build();
        assert!(matches!(built.err(), Some(TrainError::Interrupted)));
    }
}

/// By steps of the solver, and by photos where corners are looked for.
#[test]
fn the_adjustment_says_how_far_it_is() {
    let settings = refining_poses();
    let mut without = turned_with_keypoints();
    without.observations.clear();
    for (capture, fewest) in [(turned_with_keypoints(), 3), (without, 12)] {
        let shares = Arc::new(Mutex::new(Vec::new()));
        let seen = shares.clone();
        let builder = builder_on(Arc::new(capture)).settings(settings.clone());
        let builder = builder.on_adjustment(move |share| seen.lock().unwrap().push(share));
        builder.build().unwrap();
        let mut shares = shares.lock().unwrap();
        assert_eq!(shares.last(), Some(&1.0));
        assert!(shares.iter().all(|share| (0.0..=1.0).contains(share)));
        shares.dedup();
        assert!(shares.len() >= fewest, "{shares:?}");
    }
}

#[test]
fn keypoints_of_other_photos_are_left_aside() {
    let mut other = turned_with_keypoints();
    let count = other.observations.len();
    for i in 0..count {
        other.observations[i].position = other.observations[(i + 997) % count].position;
    }
    let settings = refining_poses();
    let warnings = Arc::new(Mutex::new(Vec::new()));
    let said = warnings.clone();
    let trainer = builder_on(Arc::new(other))
        .settings(settings)
        .on_warning(move |warning| said.lock().unwrap().push(warning.clone()))
        .build()
        .unwrap();
    assert!(trainer.bundle_adjustment().is_none());
    let warnings = warnings.lock().unwrap();
    assert!(
        matches!(&warnings[..], [Warning::KeypointsDoNotFit { before, after, rematched: None }] if after <= before),
        "{warnings:?}"
    );
    assert!(
        warnings[0].to_string().contains("pixels off"),
        "{warnings:?}"
    );
}

#[test]
fn a_moved_pose_finds_its_way_back() {
    let capture = capture();
    let trained = builder()
        .settings(TrainSettings::new().with_steps(400))
        .build()
        .unwrap()
        .run()
        .unwrap();
    let scene = trained.to_data().scene_scale();
    let view = capture.test_views().next().unwrap();
    let camera = view.camera();
    let turn = DMat4::from_axis_angle(DVec3::new(1.0, 2.0, -1.0).normalize(), 0.01);
    let moved = view.with_pose(&Camera {
        viewmat: turn * camera.viewmat,
        ..camera
    });
    let (settings, device) = (&trained.render_settings, Device::flex());
    let align = |view: &splat_data::View| {
        let aligned = align_pose(&trained.model, view, settings, scene, &device, 150);
        aligned.unwrap().viewmat
    };
    // A scene of a few steps fits best at a pose that is not quite the capture's, from wherever the
    // search begins.
    let (best, found) = (align(view), align(&moved));
    let angle = |a: DMat4, b: DMat4| {
        let turn = glam::DMat3::from_mat4(a * b.inverse());
        glam::DQuat::from_mat3(&turn).to_axis_angle().1
    };
    let (before, after) = (angle(turn * camera.viewmat, best), angle(found, best));
    assert!(before > 0.005, "{before}");
    assert!(after < 0.2 * before, "{after} radians are left of {before}");
}

/// What a mask hides changes neither the scene nor its scores.
#[test]
fn masked_pixels_count_in_no_loss_and_no_score() {
    let masked = |value: u8| {
        let mut capture = Capture::clone(&capture());
        for view in &mut capture.views {
            let (w, pixels) = (view.width as usize, (view.width * view.height) as usize);
            let kept = |pixel: usize| pixel % w < w / 2;
            view.mask = Some(Arc::new(
                (0..pixels).map(|p| 255 * u8::from(kept(p))).collect(),
            ));
            let mut image = view.image.to_vec();
            for (pixel, color) in image.chunks_exact_mut(3).enumerate() {
                if !kept(pixel) {
                    color.fill(value);
                }
            }
            view.image = Arc::new(image);
        }
        let trainer = builder_on(Arc::new(capture.clone()));
        let trained = trainer.settings(TrainSettings::new().with_steps(20));
        let trained = trained.build().unwrap().run().unwrap();
        let views: Vec<_> = capture.test_views().collect();
        let scores = trained
            .evaluate(&views, &Device::flex(), |_, _| {})
            .unwrap();
        (trained.model.to_data(), scores)
    };
    let (black, scores) = masked(0);
    let (white, others) = masked(255);
    assert_eq!(black.means, white.means);
    assert_eq!(black.sh0, white.sh0);
    assert_eq!(scores, others);
    assert!(scores.psnr.is_finite());
}

#[test]
fn settings_that_refine_nothing_sensible_are_named() {
    let mut config = settings();
    config.calibration.pose_rate = -1.0;
    let error = config.validate().unwrap_err();
    assert!(
        error.contains("`calibration.pose_rate` must lie in [0, 1]"),
        "{error}"
    );
    config.calibration.pose_rate = 0.1;
    config.calibration.final_share = 0.0;
    let error = config.validate().unwrap_err();
    assert!(error.contains("`calibration.final_share`"), "{error}");
}

/// The lens of a view reaches its render.
#[test]
fn a_view_is_rendered_through_its_lens() {
    let capture = capture();
    let view = &capture.views[0];
    let trained = builder()
        .settings(TrainSettings::new().with_steps(30))
        .build()
        .unwrap()
        .run()
        .unwrap();
    let image = |lens: Lens| -> Vec<f32> {
        let mut view = view.clone();
        view.lens = lens;
        let mut image = Vec::new();
        trained
            .evaluate(&[&view], &Device::flex(), |_, pixels| image = pixels)
            .unwrap();
        image
    };
    let worst = |a: &[f32], b: &[f32]| {
        let far = a.iter().zip(b).map(|(a, b)| (a - b).abs());
        far.fold(0.0, f32::max)
    };
    // Without distortion the pinhole's picture, but for the shapes of large splats that reach in
    // from outside: the clamp of their Jacobian is a circle here, a box there.
    let straight = image(Lens::OpenCv([0.0; 8]));
    let same = worst(&image(Lens::Pinhole), &straight);
    let mut k = [0.0; 8];
    k[0] = -0.2;
    let bent = worst(&image(Lens::OpenCv(k)), &straight);
    assert!(bent > 0.03 && same < 0.2 * bent, "{same} {bent}");
}
