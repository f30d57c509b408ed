//! Settings of self-calibration.

use derive_setters::Setters;
use serde::{Deserialize, Serialize};

/// Which of the cameras' parameters are refined, and how fast.
///
/// The rates are Adam's. A view takes part in one step of many, and its moments carry each of its
/// gradients on through the steps between, so that a pose moves by about the rate times the root of
/// the number of views per visit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Setters)]
#[serde(default, deny_unknown_fields)]
#[setters(prefix = "with_")]
pub struct CalibrationSettings {
    /// Refine the pose of every training view. Default false.
    pub poses: bool,
    /// Refine focal lengths, principal points and distortion, one set for all views that begin with
    /// the same. Default false.
    pub intrinsics: bool,
    /// Adjust the poses to keypoints before training, those of the capture or else corners that
    /// photos share, see [`adjust_bundle`](super::adjust_bundle). Default true.
    pub bundle_adjustment: bool,
    /// Rate of poses that were not adjusted: radians for rotations, sizes of the scene for
    /// translations. Default 1e-3.
    pub pose_rate: f64,
    /// Rate of poses that were adjusted. Default 1e-6: keypoints fix a pose to a hundredth of a
    /// degree, and photos do not know it better. gsplat has 1e-5.
    pub adjusted_pose_rate: f64,
    /// Poses are refined after so many passes over the photos, or an eighth of the run where that
    /// is shorter. Before, the first Gaussians leave holes, and cameras would turn to where the
    /// picture is fuller. Default 10.
    pub start_passes: usize,
    /// Rate of the logarithms of focal lengths. Default 5e-3: a lens must be found before the scene
    /// has made up for a wrong one.
    pub focal_rate: f64,
    /// Rate of principal points, in sides of the photo. Default 3e-4.
    pub principal_rate: f64,
    /// Rate of the first distortion coefficients; those of higher powers of the radius follow at a
    /// tenth of it for each power. Default 1e-2.
    pub distortion_rate: f64,
    /// All rates fall exponentially to this share of themselves at the end of the run. Default
    /// 0.01 (gsplat).
    pub final_share: f64,
    /// Steps that align the pose of a held-out view with the finished scene, for its second score.
    /// Default 200.
    pub align_steps: usize,
}

impl CalibrationSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }

    /// True if anything is refined.
    pub fn is_on(&self) -> bool {
        self.poses || self.intrinsics
    }

    /// Checks that the settings can be used.
    ///
    /// # Errors
    /// The field and why its value cannot be used, in one line.
    pub fn validate(&self) -> Result<(), String> {
        let rates = [
            ("pose_rate", self.pose_rate),
            ("adjusted_pose_rate", self.adjusted_pose_rate),
            ("focal_rate", self.focal_rate),
            ("principal_rate", self.principal_rate),
            ("distortion_rate", self.distortion_rate),
        ];
        let usable = |value: f64| value.is_finite() && (0.0..=1.0).contains(&value);
        if let Some((field, value)) = rates.iter().find(|(_, value)| !usable(*value)) {
            return Err(format!("`{field}` must lie in [0, 1], it is {value}"));
        }
        let share = self.final_share;
        if !(share > 0.0 && share <= 1.0) {
            return Err(format!("`final_share` must lie in (0, 1], it is {share}"));
        }
        Ok(())
    }
}

impl Default for CalibrationSettings {
    fn default() -> Self {
        Self {
            poses: false,
            intrinsics: false,
            bundle_adjustment: true,
            pose_rate: 1e-3,
            adjusted_pose_rate: 1e-6,
            start_passes: 10,
            focal_rate: 5e-3,
            principal_rate: 3e-4,
            distortion_rate: 1e-2,
            final_share: 0.01,
            align_steps: 200,
        }
    }
}
