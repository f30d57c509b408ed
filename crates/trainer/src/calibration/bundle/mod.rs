//! Bundle adjustment: poses and points that agree best with keypoints of the photos.
//!
//! Gradients of the photos find the pose of a single view, but scene and cameras can bend together
//! at little cost, and descent follows such a bend slowly. Points that several photos show tie the
//! views together. The least squares of their reprojection errors are solved to the end in seconds
//! (Triggs et al. 2000, "Bundle Adjustment: A Modern Synthesis"): by Levenberg's and Marquardt's
//! method, with Huber's loss.
//!
//! The keypoints are those of structure from motion where the capture has them, and are looked for
//! in the photos where it has none.

mod matching;
mod normal;
mod picture;
mod problem;
mod watched;

use std::sync::atomic::AtomicBool;

use glam::{DMat4, DVec3};
use splat_data::{Capture, CaptureError, View};

use matching::Photos;
use problem::{Cost, Problem, Unknowns};
pub(crate) use watched::Watched;

/// Fewest keypoints that fix a pose.
const FEWEST_KEYPOINTS: usize = 12;
/// Steps that are tried at most, in either stage.
const STEPS: usize = 50;
/// The last step has improved the cost by less than this share.
const CONVERGED: f64 = 1e-7;
/// Keypoints with a larger error in the median, as a share of the photo's longer side, are not
/// those of these photos and cameras.
const LARGEST_ERROR: f64 = 0.003;
/// Poses that are wrong by so much, as a share of the photo's longer side, are not those of the
/// keypoints: these may be of photos of another size.
const LARGEST_ERROR_BEFORE: f64 = 0.05;
/// Smaller errors, as a share of the photo's longer side, are none.
const NO_ERROR: f64 = 1e-4;
/// Huber's loss is quadratic up to this many times the median error.
const QUADRATIC: f64 = 3.0;
/// Corners are looked for this far from where they should be, as shares of the longer side: first
/// with the poses of the capture, then with better ones.
const REACHES: [f64; 3] = [1.0 / 20.0, 1.0 / 60.0, 1.0 / 60.0];
/// A match with an error of so many times the median is wrong.
const OUTLIER: f64 = 6.0;

/// Poses and points after [`adjust_bundle`].
#[derive(Debug, Clone, PartialEq)]
pub struct BundleAdjustment {
    /// View matrices (world to camera) of the training views, in their order. Those of views with
    /// fewer than twelve keypoints are unchanged.
    pub viewmats: Vec<DMat4>,
    /// Positions of the capture's points. Those that fewer than two training views observe are
    /// unchanged, and so are all if corners were matched.
    pub points: Vec<[f64; 3]>,
    /// Number of training views whose poses were adjusted.
    pub views: usize,
    /// Keypoints that were used.
    pub keypoints: usize,
    /// Median distance of keypoints and projected points before, in pixels.
    pub error_before: f64,
    /// The same after.
    pub error_after: f64,
    /// For a capture without keypoints, whose photos' corners were matched: the median error of the
    /// last matches, measured with the poses that were adjusted to the matches before them. `None`
    /// for keypoints of the capture.
    pub error_rematched: Option<f64>,
    /// True if the keypoints agree: the error after is no larger than before, and at most 0.3 % of
    /// the photo's longer side, that before at most 5 %. Matched ones must also be found anew where
    /// the adjusted poses have them, within the same bound. If false, they are those of other
    /// photos, of a lens that is not the capture's, or wrong matches, and poses and points should
    /// not be taken over.
    pub fits: bool,
}

/// Adjusts the poses of the training views to the keypoints of [`Capture::observations`], and the
/// points too: first each pose by itself, then poses and points together. Intrinsics stay as they
/// are. Held-out views take no part: nothing may be learned from them.
///
/// A capture without keypoints, as one whose
/// [`CaptureSettings::observations`](splat_data::CaptureSettings::observations) did not ask for
/// them, gets some: corners of its photos, found again in neighbouring photos by correlation,
/// within a twentieth of the photo's longer side from where poses and points have them.
///
/// `None` if no view has enough keypoints.
///
/// ```
/// use splat_data::{Capture, CaptureSettings};
/// use splat_trainer::calibration::adjust_bundle;
///
/// # let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
/// let settings = CaptureSettings::new().with_downscale(4).with_observations(true);
/// let capture = Capture::load(folder, &settings)?;
/// if let Some(adjusted) = adjust_bundle(&capture)? {
///     println!("{:.2} to {:.2} pixels", adjusted.error_before, adjusted.error_after);
/// }
/// # Ok::<(), splat_data::CaptureError>(())
/// ```
///
/// # Errors
/// When a photo on the disk cannot be read.
pub fn adjust_bundle(capture: &Capture) -> Result<Option<BundleAdjustment>, CaptureError> {
    adjust_bundle_watched(Watched::whole(&AtomicBool::new(false), &|_| {}), capture)
}

/// [`adjust_bundle`] with its progress. If it is interrupted, the result is of no use.
pub(crate) fn adjust_bundle_watched(
    watched: Watched<'_>,
    capture: &Capture,
) -> Result<Option<BundleAdjustment>, CaptureError> {
    let views: Vec<&View> = capture.train_views().collect();
    let points = capture.points.iter().map(|p| DVec3::from_array(p.position));
    let unknowns = Unknowns {
        viewmats: views.iter().map(|view| view.camera().viewmat).collect(),
        points: points.collect(),
    };
    let adjusted = match capture.observations.is_empty() {
        false => of_observations(watched, capture, &views, unknowns),
        true => of_corners(watched, &views, unknowns)?,
    };
    if !watched.is_interrupted() {
        watched.done(1, 1);
    }
    Ok(adjusted)
}

fn of_observations(
    watched: Watched<'_>,
    capture: &Capture,
    views: &[&View],
    mut unknowns: Unknowns,
) -> Option<BundleAdjustment> {
    let problem = Problem::of_capture(capture, views)?;
    let before = problem.errors(&unknowns).median();
    for (stage, free_points) in [false, true].into_iter().enumerate() {
        minimize(watched.part(stage, 2), &problem, &mut unknowns, free_points);
    }
    Some(BundleAdjustment {
        points: unknowns.points.iter().map(DVec3::to_array).collect(),
        ..result(&problem, &unknowns, before, views)
    })
}

fn of_corners(
    watched: Watched<'_>,
    views: &[&View],
    start: Unknowns,
) -> Result<Option<BundleAdjustment>, CaptureError> {
    let mut photos = Photos::of(views)?;
    let mut viewmats = start.viewmats;
    let mut adjusted: Option<BundleAdjustment> = None;
    for (round, reach) in REACHES.into_iter().enumerate() {
        let watched = watched.part(round, REACHES.len());
        let [search, solve] = [0, 1].map(|half| watched.part(half, 2));
        photos.place(&viewmats);
        let matched = photos.matched(search, &start.points, reach);
        let mut unknowns = Unknowns {
            viewmats,
            points: matched.points,
        };
        let Some(problem) = Problem::new(views, unknowns.points.len(), matched.sights) else {
            return Ok(None);
        };
        let before = problem.errors(&unknowns).median();
        minimize(solve.part(0, 2), &problem, &mut unknowns, true);
        let Some(problem) = problem.without_outliers(&unknowns, OUTLIER) else {
            return Ok(None);
        };
        minimize(solve.part(1, 2), &problem, &mut unknowns, true);
        let next = result(&problem, &unknowns, before, views);
        adjusted = Some(BundleAdjustment {
            // Wrong matches agree with the poses that follow from them, but new ones do not.
            fits: next.fits && before <= LARGEST_ERROR * longer(views),
            error_before: adjusted.map_or(before, |first| first.error_before),
            points: start.points.iter().map(DVec3::to_array).collect(),
            error_rematched: Some(before),
            ..next
        });
        viewmats = unknowns.viewmats;
    }
    Ok(adjusted)
}

/// The result of adjusting to keypoints of the capture, but for its points.
fn result(
    problem: &Problem<'_>,
    unknowns: &Unknowns,
    error_before: f64,
    views: &[&View],
) -> BundleAdjustment {
    let error_after = problem.errors(unknowns).median();
    BundleAdjustment {
        viewmats: unknowns.viewmats.clone(),
        points: vec![],
        views: problem.observing_views(),
        keypoints: problem.sights.len(),
        error_before,
        error_after,
        error_rematched: None,
        // Not so with NaN.
        fits: error_after <= error_before.max(NO_ERROR * longer(views))
            && error_before <= LARGEST_ERROR_BEFORE * longer(views)
            && error_after <= LARGEST_ERROR * longer(views),
    }
}

/// The longest side of all photos, in pixels.
fn longer(views: &[&View]) -> f64 {
    let longer = views.iter().map(|view| view.width.max(view.height)).max();
    f64::from(longer.unwrap_or(0))
}

/// Levenberg's and Marquardt's method: Gauss and Newton's step, whose diagonal grows while steps
/// fail and shrinks while they succeed.
fn minimize(
    watched: Watched<'_>,
    problem: &Problem<'_>,
    unknowns: &mut Unknowns,
    free_points: bool,
) {
    let mut damping = 1e-4;
    let mut now = problem.linearized(unknowns);
    for step in 0..STEPS {
        if watched.is_interrupted() {
            return;
        }
        watched.done(step, STEPS);
        // Huber's bound follows the errors, and is the same for both sides of a comparison.
        let cost = Cost {
            quadratic: QUADRATIC * now.errors.median(),
        };
        let Some(step) = normal::step(problem, &now, cost, damping, free_points) else {
            return;
        };
        let moved = unknowns.moved(&step);
        let (old, new) = (cost.of(&now.errors), cost.of(&problem.errors(&moved)));
        if new < old {
            *unknowns = moved;
            now = problem.linearized(unknowns);
            damping = (damping / 10.0).max(1e-9);
        } else {
            damping *= 10.0;
        }
        if new <= old && old - new <= CONVERGED * old || damping > 1e6 {
            return;
        }
    }
}

#[cfg(test)]
mod tests;
