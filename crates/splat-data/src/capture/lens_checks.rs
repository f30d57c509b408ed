//! Lenses whose domain does not reach the border of their photos.

use std::collections::HashSet;

use super::sparse_model::SparseModel;
use super::{CaptureWarning, View};

/// Pixels along each side at which a lens is tried.
const TRIED: u32 = 33;

/// Cameras that see nothing at a corner of their photos: their calibration was fitted to the
/// middle, and folds back before the border, or the photo is the round one of a fisheye. A splat
/// falls on no such pixel, whatever training does. The views are those of the model's images.
pub(super) fn fold_back(model: &SparseModel, views: &[View]) -> Option<CaptureWarning> {
    let mut seen = HashSet::new();
    let mut first = None;
    let mut count = 0;
    for (image, view) in model.images.iter().zip(views) {
        if !seen.insert(image.camera_id) || sees_corners(view) {
            continue;
        }
        count += 1;
        first.get_or_insert((image.camera_id, view));
    }
    let (camera, view) = first?;
    Some(CaptureWarning::LensFoldsBack {
        count,
        camera,
        share: blind_share(view),
    })
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
