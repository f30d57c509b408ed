//! Bundle adjustment: poses and points that agree best with the keypoints of the capture.
//!
//! Gradients of the photos find the pose of a single view, but scene and cameras can bend together
//! at little cost, and descent follows such a bend slowly. The keypoints that structure from motion
//! matched tie all views together, and the least squares of their reprojection errors are solved to
//! the end in seconds (Triggs et al. 2000, "Bundle Adjustment: A Modern Synthesis"): by
//! Levenberg's and Marquardt's method, with Huber's loss, first for each pose by itself, then for
//! poses and points together.

mod normal;
mod problem;

use glam::{DMat4, DVec3, DVec4};
use splat_data::{Capture, View};

use problem::{Cost, Problem, Unknowns};

/// Fewest keypoints that fix a pose.
const FEWEST_KEYPOINTS: usize = 12;
/// Steps that are tried at most, in either stage.
const STEPS: usize = 50;
/// The last step has improved the cost by less than this share.
const CONVERGED: f64 = 1e-7;
/// Keypoints with a larger error in the median, as a share of the photo's longer side, are not
/// those of these photos and cameras.
const LARGEST_ERROR: f64 = 0.003;
/// Huber's loss is quadratic up to this many times the median error.
const QUADRATIC: f64 = 3.0;

/// Poses and points after [`adjust_bundle`].
#[derive(Debug, Clone, PartialEq)]
pub struct BundleAdjustment {
    /// View matrices (world to camera) of the training views, in their order. Those of views with
    /// fewer than twelve keypoints are unchanged.
    pub viewmats: Vec<DMat4>,
    /// Positions of the capture's points. Those that fewer than two training views observe are
    /// unchanged.
    pub points: Vec<[f64; 3]>,
    /// Keypoints that were used.
    pub keypoints: usize,
    /// Median distance of keypoints and projected points before, in pixels.
    pub error_before: f64,
    /// The same after.
    pub error_after: f64,
    /// True if the keypoints agree: the error after is no larger than before, and at most 0.3 % of
    /// the photo's longer side. If false, they are those of other photos or of a lens that is not
    /// the capture's, and poses and points should not be taken over.
    pub fits: bool,
}

/// Adjusts the poses of the training views, and the points, to the keypoints of
/// [`Capture::observations`]. Intrinsics stay as they are. Held-out views take no part: nothing may
/// be learned from them.
///
/// `None` if the capture has no keypoints, as when
/// [`CaptureSettings::observations`](splat_data::CaptureSettings::observations) did not ask for
/// them, or no view has enough.
///
/// ```
/// use splat_data::{Capture, CaptureSettings};
/// use splat_trainer::calibration::adjust_bundle;
///
/// # let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
/// let settings = CaptureSettings::new().with_downscale(8).with_observations(true);
/// let capture = Capture::load(folder, &settings)?;
/// if let Some(adjusted) = adjust_bundle(&capture) {
///     println!("{:.2} to {:.2} pixels", adjusted.error_before, adjusted.error_after);
/// }
/// # Ok::<(), splat_data::CaptureError>(())
/// ```
pub fn adjust_bundle(capture: &Capture) -> Option<BundleAdjustment> {
    let views: Vec<&View> = capture.train_views().collect();
    let problem = Problem::new(capture, &views)?;
    let mut unknowns = Unknowns {
        viewmats: views.iter().map(|view| viewmat(view)).collect(),
        points: (capture.points.iter())
            .map(|point| DVec3::from_array(point.position))
            .collect(),
    };
    let before = problem.errors(&unknowns);
    for free_points in [false, true] {
        minimize(&problem, &mut unknowns, free_points);
    }
    let after = problem.errors(&unknowns);
    let longer = views.iter().map(|view| view.width.max(view.height)).max();
    let [error_before, error_after] = [before.median(), after.median()];
    Some(BundleAdjustment {
        viewmats: unknowns.viewmats,
        points: unknowns.points.iter().map(DVec3::to_array).collect(),
        keypoints: problem.sights.len(),
        error_before,
        error_after,
        // Not so with NaN.
        fits: error_after <= error_before
            && error_after <= LARGEST_ERROR * f64::from(longer.unwrap_or(0)),
    })
}

fn viewmat(view: &View) -> DMat4 {
    let [x, y, z, w] = view.viewmat.map(DVec4::from_array);
    DMat4::from_cols(x, y, z, w).transpose()
}

/// Levenberg's and Marquardt's method: Gauss and Newton's step, whose diagonal grows while steps
/// fail and shrinks while they succeed.
fn minimize(problem: &Problem<'_>, unknowns: &mut Unknowns, free_points: bool) {
    let mut damping = 1e-4;
    let mut now = problem.linearized(unknowns);
    for _ in 0..STEPS {
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
