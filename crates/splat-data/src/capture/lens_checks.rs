//! Cameras that can hardly have taken their photos: a principal point far outside, or a lens whose
//! domain does not reach the border.

use std::collections::HashMap;

use super::{CaptureWarning, View};

/// Pixels along each side at which a lens is tried.
const TRIED: u32 = 33;

/// The warnings about intrinsics and lenses.
pub(super) fn check(views: &[View]) -> Vec<CaptureWarning> {
    let mut warnings = Vec::new();
    warnings.extend(far_centers(views));
    warnings.extend(fold_back(views));
    warnings
}

/// Views whose principal point is outside of the photo by more than the photo's size. It is about
/// the middle of a photo, and outside only if the photo was cut out of a larger one.
fn far_centers(views: &[View]) -> Option<CaptureWarning> {
    let found = odd(views, is_far);
    let first = found.first()?;
    let [_, _, cx, cy] = first.intrinsics;
    Some(CaptureWarning::PrincipalPointFarAway {
        count: found.len(),
        first: first.name.clone(),
        center: [cx, cy],
        size: [first.width, first.height],
    })
}

/// Views with a lens that sees nothing at a corner of the photo: its calibration was fitted to the
/// middle, and folds back before the border, or the photo is the round one of a fisheye. A splat
/// falls on no such pixel, whatever training does. Where the principal point is far away, that is
/// the fault, and not the lens.
fn fold_back(views: &[View]) -> Option<CaptureWarning> {
    let found = odd(views, |view| !is_far(view) && !sees_corners(view));
    let first = found.first()?;
    Some(CaptureWarning::LensFoldsBack {
        count: found.len(),
        first: first.name.clone(),
        share: blind_share(first),
    })
}

/// The views whose intrinsics, lens and size are odd. Most views share these with others, so that
/// each kind is looked at once. (The ids of cameras do not tell them apart: the cameras may be
/// those of another model.)
fn odd(views: &[View], is_odd: impl Fn(&View) -> bool) -> Vec<&View> {
    let mut known = HashMap::new();
    let mut found = Vec::new();
    for view in views {
        if *known.entry(kind(view)).or_insert_with(|| is_odd(view)) {
            found.push(view);
        }
    }
    found
}

/// Equal for views with the same intrinsics, lens and size. Models of lenses differ in their number
/// of coefficients.
fn kind(view: &View) -> ([u32; 2], Vec<u64>) {
    let numbers = view.intrinsics.iter().chain(view.lens.coefficients());
    let numbers = numbers.map(|number| number.to_bits()).collect();
    ([view.width, view.height], numbers)
}

fn is_far(view: &View) -> bool {
    let [_, _, cx, cy] = view.intrinsics;
    let is_near = |at: f64, side: u32| (-f64::from(side)..=2.0 * f64::from(side)).contains(&at);
    !is_near(cx, view.width) || !is_near(cy, view.height)
}

fn sees_corners(view: &View) -> bool {
    let (w, h) = (f64::from(view.width), f64::from(view.height));
    let corners = [[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]];
    corners.iter().all(|corner| sees(view, *corner))
}

/// True if a direction falls on this position in the photo.
fn sees(view: &View, [x, y]: [f64; 2]) -> bool {
    let [fx, fy, cx, cy] = view.intrinsics;
    view.lens
        .undistort([(x - cx) / fx, (y - cy) / fy])
        .is_some()
}

/// Share of the pixels on which no direction falls, from a grid of them.
fn blind_share(view: &View) -> f64 {
    let at = |index: u32, side: u32| f64::from(side) * f64::from(index) / f64::from(TRIED - 1);
    let grid = (0..TRIED).flat_map(|y| (0..TRIED).map(move |x| (x, y)));
    let blind = grid.filter(|&(x, y)| !sees(view, [at(x, view.width), at(y, view.height)]));
    blind.count() as f64 / f64::from(TRIED * TRIED)
}

#[cfg(test)]
mod tests {
    use splat_core::Lens;

    use super::super::test_capture::{good, load};
    use super::*;
    use crate::{Capture, CaptureSettings};

    /// Folds back at a radius of 0.58, inside of the photos of [`good`].
    const FOLDS: Lens = Lens::OpenCv([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);

    #[test]
    fn a_principal_point_far_outside_of_the_photo_is_named() {
        // PINHOLE, and OPENCV with a lens that is not defined so far outside.
        for (model, lens) in [(1, &[][..]), (4, &[-0.1, 0.0, 0.0, 0.0][..])] {
            for (center, is_told) in [
                ([8000.0, 12.5], true),
                ([15.75, -24.1], true),
                ([15.75, 48.1], true),
                ([f64::from(i32::MIN), 12.5], true),
                ([15.75, 12.5], false),
            ] {
                let (root, mut capture) = good();
                capture.cameras[0].1 = model;
                capture.cameras[0].4 = [&[40.5, 41.25][..], &center[..], lens].concat();
                capture.write_binary(&root.path().join("sparse/0"));
                let expected = CaptureWarning::PrincipalPointFarAway {
                    count: 6,
                    first: "view r.png".into(),
                    center,
                    size: [32, 24],
                };
                let expected: Vec<_> = is_told.then_some(expected).into_iter().collect();
                assert_eq!(load(root.path()).unwrap().warnings, expected);
            }
        }
        let warning = CaptureWarning::PrincipalPointFarAway {
            count: 6,
            first: "view r.png".into(),
            center: [8000.0, 12.5],
            size: [32, 24],
        };
        let message = warning.to_string();
        for word in ["6 photo(s)", "view r.png", "(8000.0, 12.5)", "32x24"] {
            assert!(message.contains(word), "{message}");
        }
    }

    /// A crop may have its principal point outside, by less than its size.
    #[test]
    fn a_principal_point_near_the_photo_is_none_of_our_business() {
        let (root, mut capture) = good();
        capture.cameras[0].4 = vec![40.5, 41.25, -31.0, 47.0];
        capture.write_binary(&root.path().join("sparse/0"));
        assert_eq!(load(root.path()).unwrap().warnings, []);
    }

    /// The views that share one camera in the capture have two in the other model.
    #[test]
    fn each_camera_of_another_model_is_looked_at() {
        let (root, _) = good();
        let settings = CaptureSettings::new();
        let mut other = Capture::load(root.path(), &settings).unwrap();
        let [first, second] = [0, 1].map(|index| &other.views[index]);
        assert_eq!(
            (first.intrinsics, first.lens),
            (second.intrinsics, second.lens)
        );
        other.views[1].lens = FOLDS;
        let model = tempfile::tempdir().unwrap();
        let model = model.path().join("cameras");
        other.save_model(&model).unwrap();

        let settings = settings.with_cameras(model);
        let warnings = Capture::load(root.path(), &settings).unwrap().warnings;
        let [
            CaptureWarning::LensFoldsBack {
                count: 1, first, ..
            },
        ] = &warnings[..]
        else {
            panic!("a warning, not {warnings:?}");
        };
        assert_eq!(*first, other.views[1].name);
    }
}
