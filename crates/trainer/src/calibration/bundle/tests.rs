use std::sync::Arc;

use splat_data::{Lens, Observation, Point, Split};

use super::*;

const VIEWS: usize = 8;

/// Points in a ball, and cameras around it that observe all of them exactly, the last two held out.
fn capture(lens: Lens) -> Capture {
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
            let angle = 0.4 * i as f64;
            let from = DVec3::new(4.0 * angle.sin(), 0.3 * angle, -4.0 * angle.cos());
            let viewmat = glam::DMat4::look_at_lh(from, DVec3::ZERO, DVec3::Y);
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
        let shift = DMat4::from_translation(0.1 * axis.zxy());
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
        let adjusted = adjust_bundle(&moved).unwrap();
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
        assert_eq!(adjust_bundle(&moved).unwrap(), adjusted);
    }
}

#[test]
fn true_poses_stay_where_they_are() {
    let truth = capture(Lens::Pinhole);
    let adjusted = adjust_bundle(&truth).unwrap();
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
    assert!(!adjust_bundle(&capture).unwrap().fits);
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
    let adjusted = adjust_bundle(&capture).unwrap();
    assert_eq!(adjusted.viewmats[2], viewmat(&capture.views[2]));
    assert_ne!(adjusted.viewmats[1], viewmat(&capture.views[1]));
    assert_eq!(adjusted.keypoints, 5 * 120);

    capture
        .observations
        .retain(|observation| observation.view < 1);
    assert_eq!(adjust_bundle(&capture), None);
    capture.observations.clear();
    assert_eq!(adjust_bundle(&capture), None);
    // Indices of nothing.
    capture.observations = vec![
        Observation {
            view: 99,
            point: 7,
            position: [0.0; 2]
        };
        30
    ];
    assert_eq!(adjust_bundle(&capture), None);
}

#[test]
fn a_wrong_keypoint_does_not_pull() {
    let truth = capture(Lens::Pinhole);
    let mut moved = perturbed(&truth);
    for observation in moved.observations.iter_mut().step_by(40) {
        observation.position[0] += 0.2;
    }
    let adjusted = adjust_bundle(&moved).unwrap();
    // Least squares would be off by pixels.
    assert!(adjusted.fits && adjusted.error_after < 0.1, "{adjusted:?}");
}
