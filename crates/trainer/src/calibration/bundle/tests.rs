use std::sync::Arc;

use splat_data::{Lens, Observation, Point, Split};

use super::*;

const VIEWS: usize = 8;

/// Points in a ball, and cameras around it that observe all of them exactly, the last two held out.
fn capture(lens: Lens) -> Capture {
    around(lens, 0.4)
}

/// The same with an angle between neighbouring cameras, in radians.
fn around(lens: Lens, step: f64) -> Capture {
    let points: Vec<Point> = (0..120)
        .map(|i| {
            let [a, b, c] = [2.399, 0.911, 0.377].map(|step| f64::from(i) * step);
            let position = [a.sin(), 0.8 * b.sin(), c.cos()];
            let color = [128; 3];
            Point { position, color }
        })
        .collect();
    let views: Vec<View> = (0..VIEWS)
        .map(|i| {
            let angle = step * i as f64;
            let from = DVec3::new(4.0 * angle.sin(), 0.3 * angle, -4.0 * angle.cos());
            let ahead = -from.normalize();
            let right = DVec3::Y.cross(ahead).normalize();
            let turn = glam::DMat3::from_cols(right, ahead.cross(right), ahead).transpose();
            let viewmat = DMat4::from_mat3(turn) * DMat4::from_translation(-from);
            View {
                name: format!("{i}.png"),
                width: 400,
                height: 300,
                intrinsics: [300.0, 310.0, 200.0, 150.0],
                viewmat: rows(viewmat),
                lens,
                image: Arc::default(),
                mask: None,
                depth: None,
                on_disk: None,
            }
        })
        .collect();
    let mut observations = Vec::new();
    for (view, seen) in views.iter().enumerate() {
        for (point, there) in points.iter().enumerate() {
            let ([x, y], _) = seen.project(there.position).unwrap();
            let [fx, fy, cx, cy] = seen.intrinsics;
            observations.push(Observation {
                view: view as u32,
                point: point as u32,
                position: [(x - cx) / fx, (y - cy) / fy],
            });
        }
    }
    Capture {
        name: "ball".into(),
        root: "ball".into(),
        photos: "ball".into(),
        views,
        points,
        observations,
        background: None,
        split: Split {
            train: (0..VIEWS - 2).collect(),
            test: vec![VIEWS - 2, VIEWS - 1],
        },
        warnings: vec![],
    }
}

fn viewmat(view: &View) -> DMat4 {
    view.camera().viewmat
}

fn adjust(capture: &Capture) -> BundleAdjustment {
    adjust_bundle(capture).unwrap().unwrap()
}

fn rows(viewmat: DMat4) -> [[f64; 4]; 4] {
    std::array::from_fn(|i| viewmat.row(i).to_array())
}

/// Every camera turned by a degree and moved by a fortieth of its distance, each in its own
/// direction, and points moved by a fiftieth.
fn perturbed(truth: &Capture) -> Capture {
    let mut capture = truth.clone();
    for (i, view) in capture.views.iter_mut().enumerate() {
        let axis = DVec3::new((3.0 * i as f64).sin(), (5.0 * i as f64).cos(), 0.3).normalize();
        let turn = DMat4::from_axis_angle(axis, 1f64.to_radians());
        let shift = DMat4::from_translation(0.1 * DVec3::new(axis.z, axis.x, axis.y));
        view.viewmat = rows(shift * turn * viewmat(view));
    }
    for (i, point) in capture.points.iter_mut().enumerate() {
        point.position[i % 3] += 0.02 * (7.0 * i as f64).sin();
    }
    capture
}

/// Largest error of all keypoints of training views, in pixels.
fn worst(capture: &Capture, adjusted: &BundleAdjustment) -> f64 {
    let error = |observation: &Observation| {
        let view = observation.view as usize;
        let viewmat = *adjusted.viewmats.get(view)?;
        let view = &capture.views[view];
        let point = DVec3::from_array(adjusted.points[observation.point as usize]);
        let [a, b] = view
            .lens
            .distort(viewmat.transform_point3(point).to_array())?;
        let [x, y] = observation.position;
        Some((view.intrinsics[0] * (a - x)).hypot(view.intrinsics[1] * (b - y)))
    };
    let errors = capture.observations.iter().filter_map(error);
    errors.fold(0.0, f64::max)
}

#[test]
fn poses_and_points_agree_with_their_keypoints_again() {
    let mut k = [0.0; 8];
    (k[0], k[1], k[2]) = (-0.15, 0.03, 0.002);
    for lens in [Lens::Pinhole, Lens::OpenCv(k)] {
        let truth = capture(lens);
        let moved = perturbed(&truth);
        let adjusted = adjust(&moved);
        assert!(adjusted.fits && adjusted.error_before > 3.0, "{adjusted:?}");
        let worst = worst(&moved, &adjusted);
        assert!(worst < 1e-6, "{worst}");
        // Six views of 120 points; held-out views take no part.
        assert_eq!(adjusted.keypoints, 6 * 120);
        assert_eq!(adjusted.viewmats.len(), 6);
        // The shape is that of the truth: distances of cameras have one ratio.
        let centers = |viewmats: &mut dyn Iterator<Item = DMat4>| -> Vec<DVec3> {
            viewmats.map(|m| m.inverse().w_axis.truncate()).collect()
        };
        let found = centers(&mut adjusted.viewmats.iter().copied());
        let true_ones = centers(&mut truth.train_views().map(viewmat));
        let scale = found[0].distance(found[5]) / true_ones[0].distance(true_ones[5]);
        assert!((scale - 1.0).abs() < 0.02, "{scale}");
        for i in 1..6 {
            let [a, b] = [&found, &true_ones].map(|c| c[i - 1].distance(c[i]));
            assert!((a / (scale * b) - 1.0).abs() < 1e-6, "{a} {b}");
        }
        assert_eq!(adjust(&moved), adjusted);
    }
}

#[test]
fn true_poses_stay_where_they_are() {
    let truth = capture(Lens::Pinhole);
    let adjusted = adjust(&truth);
    for (after, view) in adjusted.viewmats.iter().zip(truth.train_views()) {
        let off = *after - viewmat(view);
        assert!(off.to_cols_array().iter().all(|x| x.abs() < 1e-9), "{off}");
    }
}

#[test]
fn keypoints_of_other_photos_do_not_fit() {
    let mut capture = capture(Lens::Pinhole);
    let count = capture.observations.len();
    for i in 0..count {
        let other = (7 * i + 13) % count;
        capture.observations[i].point = capture.observations[other].point;
    }
    assert!(!adjust(&capture).fits);
}

/// As of photos that were resampled since: a scene can be bent to agree with them.
#[test]
fn keypoints_of_photos_of_another_size_do_not_fit() {
    let mut capture = capture(Lens::Pinhole);
    for observation in &mut capture.observations {
        observation.position = observation.position.map(|x| 0.5 * x - 0.15);
    }
    assert!(!adjust(&capture).fits);
}

#[test]
fn views_without_enough_keypoints_stay_where_they_are() {
    let mut capture = perturbed(&capture(Lens::Pinhole));
    let mut left = 11;
    capture.observations.retain(|observation| {
        let of_third = observation.view == 2;
        left -= i32::from(of_third && left > 0);
        !of_third || left > 0
    });
    let adjusted = adjust(&capture);
    assert_eq!(adjusted.viewmats[2], viewmat(&capture.views[2]));
    assert_ne!(adjusted.viewmats[1], viewmat(&capture.views[1]));
    assert_eq!((adjusted.views, adjusted.keypoints), (5, 5 * 120));

    capture
        .observations
        .retain(|observation| observation.view < 1);
    assert_eq!(adjust_bundle(&capture).unwrap(), None);
    // Indices of nothing.
    capture.observations = vec![
        Observation {
            view: 99,
            point: 7,
            position: [0.0; 2]
        };
        30
    ];
    assert_eq!(adjust_bundle(&capture).unwrap(), None);
}

#[test]
fn a_wrong_keypoint_does_not_pull() {
    let truth = capture(Lens::Pinhole);
    let mut moved = perturbed(&truth);
    for observation in moved.observations.iter_mut().step_by(40) {
        observation.position[0] += 0.2;
    }
    let adjusted = adjust(&moved);
    // Least squares would be off by pixels.
    assert!(adjusted.fits && adjusted.error_after < 0.1, "{adjusted:?}");
}

/// Angles between neighbouring views that differ from those of the truth, in degrees: the median. A
/// turn of all views at once is no error.
fn median_turn(truth: &[DMat4], viewmats: &[DMat4]) -> f64 {
    let rotation = |m: &DMat4| glam::DMat3::from_mat4(*m);
    let between = |of: &[DMat4], i: usize| rotation(&of[i]) * rotation(&of[i + 1]).transpose();
    let mut turns: Vec<f64> = (0..truth.len() - 1)
        .map(|i| between(truth, i).transpose() * between(viewmats, i))
        .map(|turn| (glam::DQuat::from_mat3(&turn).to_axis_angle().1).to_degrees())
        .collect();
    turns.sort_by(f64::total_cmp);
    turns[turns.len() / 2]
}

/// Grey of the surface, which repeats nowhere.
fn texture(x: f64, y: f64) -> f64 {
    let wave = |i: i32| {
        let i = f64::from(i);
        let (frequency, angle) = (5.0 + 3.1 * i, 2.4 * i);
        (frequency * (x * angle.cos() + y * angle.sin()) + i * i).sin()
    };
    0.5 + 0.09 * (0..9).map(wave).sum::<f64>()
}

/// The capture's cameras on a folded wall, z = 0.4 |x|, with photos of it, points on it, and no
/// keypoints.
fn photographed() -> Capture {
    let mut capture = around(Lens::Pinhole, 0.08);
    capture.observations.clear();
    for (i, point) in capture.points.iter_mut().enumerate() {
        let [x, y] = [(i % 12) as f64 / 4.0 - 1.4, (i / 12) as f64 / 4.0 - 1.1];
        point.position = [x, y, 0.4 * x.abs()];
    }
    for view in &mut capture.views {
        let to_world = viewmat(view).inverse();
        let [fx, fy, cx, cy] = view.intrinsics;
        let from = to_world.w_axis.truncate();
        let grey = |at: u32| {
            let (x, y) = (
                f64::from(at % view.width) + 0.5,
                f64::from(at / view.width) + 0.5,
            );
            let ray = to_world.transform_vector3(DVec3::new((x - cx) / fx, (y - cy) / fy, 1.0));
            // On either half of the wall: from.z + t ray.z = side 0.4 (from.x + t ray.x).
            let hit = |side: f64| {
                let t = (0.4 * side * from.x - from.z) / (ray.z - 0.4 * side * ray.x);
                let point = from + t * ray;
                (t > 0.0 && point.x * side >= 0.0).then_some((t, point))
            };
            let nearest = [hit(1.0), hit(-1.0)].into_iter().flatten();
            let nearest = nearest.min_by(|a, b| a.0.total_cmp(&b.0));
            nearest.map_or(0, |(_, point)| (255.0 * texture(point.x, point.y)) as u8)
        };
        let pixels = 0..view.width * view.height;
        view.image = Arc::new(pixels.flat_map(|at| [grey(at); 3]).collect());
    }
    capture
}

#[test]
fn photos_without_keypoints_get_some() {
    let truth = photographed();
    let mut moved = perturbed(&truth);
    moved.points = truth.points.clone();
    let of = |capture: &Capture| -> Vec<DMat4> { capture.train_views().map(viewmat).collect() };
    let adjusted = adjust(&moved);
    let BundleAdjustment {
        keypoints,
        error_after,
        ..
    } = adjusted;
    assert!(
        adjusted.fits
            && adjusted
                .error_rematched
                .is_some_and(|error| error < adjusted.error_before),
        "{keypoints} {error_after}"
    );
    let (before, after) = (
        median_turn(&of(&truth), &of(&moved)),
        median_turn(&of(&truth), &adjusted.viewmats),
    );
    assert!(before > 0.5 && after < 0.1, "{before} {after}");
    // Points stay, and so it is every time.
    assert_eq!(adjusted.points[7], truth.points[7].position);
    assert_eq!(adjust(&moved), adjusted);
}

/// Views all around a statue have few corners in common, and what is found there is wrong.
#[test]
fn wrong_matches_do_not_fit() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
    let truth = Capture::load(folder, &splat_data::CaptureSettings::new()).unwrap();
    assert!(truth.observations.is_empty());
    assert!(
        adjust_bundle(&perturbed(&truth))
            .unwrap()
            .is_none_or(|adjusted| !adjusted.fits)
    );
}
