//! Self-calibration: cameras that are refined while the scene is trained.
//!
//! Two modules, each a [`Hook`](crate::Hook): [`RefinePoses`] moves every training view, and
//! [`RefineIntrinsics`] corrects focal lengths, principal points and distortion.
//! [`TrainSettings::calibration`](crate::TrainSettings::calibration) adds them to a run; a run of
//! your own can add them with [`TrainerBuilder::hook`](crate::TrainerBuilder::hook).

mod align;
mod bundle;
mod intrinsics;
mod motion;
mod poses;
mod schedule;
mod settings;

pub(crate) use align::Aligning;
pub use align::{AlignedScores, align_pose};
pub use bundle::{BundleAdjustment, adjust_bundle};
pub(crate) use bundle::{Watched, adjust_bundle_watched};
pub use intrinsics::RefineIntrinsics;
pub use poses::RefinePoses;
pub use schedule::CalibrationSchedule;
pub use settings::CalibrationSettings;
