//! Warnings about a run: before it, from the capture and the settings, and during it, from the
//! losses.
//!
//! A warning stops nothing. Thresholds are relative to the medians of the other cameras, photos or
//! views, so that a single outlier stands out, and a scene of unusual size or kind does not.

pub(super) mod capture_checks;
pub(super) mod loss_checks;

use std::fmt;

use serde::{Deserialize, Serialize};

/// A problem with a run. `Display` gives one line: the problem, its extent, and the remedy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[non_exhaustive]
pub enum Warning {
    /// Many points coincide exactly.
    CoincidentPoints {
        /// Number of points at the position of another one.
        count: usize,
        /// Number of points.
        points: usize,
    },
    /// Most points lie within a region that is tiny as seen by the cameras.
    CompactPoints {
        /// Radius around their median that contains half of the points, world units.
        radius: f64,
        /// Median distance of the cameras, world units.
        distance: f64,
    },
    /// The initial Gaussians are so large that one covers most of a picture.
    LargeGaussians {
        /// Their median standard deviation, world units.
        scale: f64,
        /// Median distance of the cameras, world units.
        distance: f64,
        /// `init.scale`.
        init_scale: f64,
    },
    /// All cameras of the training photos stand in one place.
    CamerasInOnePlace {
        /// Number of training photos.
        views: usize,
        /// The place, world units.
        place: [f64; 3],
    },
    /// Cameras among the points, where other cameras are not.
    CamerasInsidePoints {
        /// Names of their photos.
        views: Vec<String>,
        /// Distance from the first of them that includes 1 % of the points, world units.
        near: f64,
        /// Median of that distance over all cameras.
        usual: f64,
    },
    /// Cameras many times farther from the points than the others.
    CamerasFarAway {
        /// Names of their photos.
        views: Vec<String>,
        /// Median distance of the points from the first of them, world units.
        distance: f64,
        /// Median of that distance over all cameras.
        usual: f64,
    },
    /// Cameras that see almost none of the points.
    CamerasSeeFewPoints {
        /// Names of their photos.
        views: Vec<String>,
        /// Points that the first of them sees.
        seen: usize,
        /// Number of points.
        points: usize,
    },
    /// Photos whose neighbouring pixels are unrelated.
    NoisePhotos {
        /// Their names.
        views: Vec<String>,
        /// Number of photos.
        photos: usize,
    },
    /// Learning rates far above the defaults.
    HighRates {
        /// Each setting, as a multiple of its default.
        rates: Vec<(String, f64)>,
    },
    /// Photos of a resumed run whose pixels have changed since it began.
    PhotosChanged {
        /// Their names.
        views: Vec<String>,
    },
    /// Growth is limited to fewer Gaussians than the run begins with.
    NoRoomToGrow {
        /// The limit.
        limit: usize,
        /// Gaussians that there are.
        gaussians: usize,
        /// True if the limit is the default for the photos.
        by_default: bool,
    },
    /// Natural selection keeps fewer Gaussians than the run begins with.
    SelectionOfFew {
        /// How many it keeps.
        survivors: usize,
        /// Gaussians that there are.
        gaussians: usize,
    },
    /// [`TrainSettings::sh_reduction`](super::TrainSettings::sh_reduction) asks for a reduction
    /// that the run is too short for.
    ShReductionNeverDue,
    /// No training views have enough keypoints in common to adjust their poses to.
    TooFewKeypoints,
    /// The keypoints disagree with the photos and cameras.
    KeypointsDoNotFit {
        /// Their median distance from the projected points, pixels.
        before: f64,
        /// The least that poses and points can reach.
        after: f64,
        /// If they are corners that were matched: their distance when they were matched anew.
        rematched: Option<f64>,
    },
    /// The state of the run could not be saved.
    NotSaved {
        /// Steps done.
        step: usize,
        /// The reason, in one line that names the file.
        reason: String,
    },
    /// The loss of a step was NaN or infinite.
    LossNotFinite {
        /// Name of the photo.
        view: String,
        /// The first such step, from 1.
        step: usize,
    },
    /// Views whose loss stays far above that of the others.
    HardViews {
        /// Names of their photos.
        views: Vec<String>,
        /// Steps done.
        step: usize,
        /// Median loss of the first of them.
        loss: f64,
        /// Median loss of all views.
        usual: f64,
    },
    /// The loss is rising.
    LossRises {
        /// Steps done.
        step: usize,
        /// Median loss over the last quarter of the run.
        loss: f64,
        /// The smallest earlier median.
        least: f64,
    },
    /// The loss has not fallen.
    LossDoesNotFall {
        /// Steps done.
        step: usize,
        /// Median loss at the start.
        first: f64,
        /// Median loss over the last quarter of the run.
        last: f64,
    },
}

impl Warning {
    /// The part that `known` does not cover yet. A loss that is not finite is new for each photo,
    /// hard views for each name, and everything else once.
    pub(super) fn beyond(mut self, known: &[Self]) -> Option<Self> {
        for other in known {
            match (&mut self, other) {
                (Self::HardViews { views, .. }, Self::HardViews { views: named, .. }) => {
                    views.retain(|view| !named.contains(view));
                }
                (Self::LossNotFinite { view, .. }, Self::LossNotFinite { view: named, .. }) => {
                    if view == named {
                        return None;
                    }
                }
                (new, old) => {
                    if core::mem::discriminant(new) == core::mem::discriminant(old) {
                        return None;
                    }
                }
            }
        }
        match &self {
            Self::HardViews { views, .. } if views.is_empty() => None,
            _ => Some(self),
        }
    }
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::CoincidentPoints { count, points } => write!(
                f,
                "{count} of {points} points lie exactly where another one does; the reconstruction (points3D) looks damaged"
            ),
            Self::CompactPoints { radius, distance } => write!(
                f,
                "half of the points lie within {} of one place, {} from the cameras; points and cameras seem to differ in scale",
                Length(*radius),
                Length(*distance)
            ),
            Self::LargeGaussians {
                scale,
                distance,
                init_scale,
            } => write!(
                f,
                "the first Gaussians are {} wide at a distance of {}, each covers most of a picture; init.scale is {init_scale} (usually 1), or the points are too few",
                Length(*scale),
                Length(*distance)
            ),
            Self::CamerasInOnePlace {
                views,
                place: [x, y, z],
            } => write!(
                f,
                "the cameras of all {views} training photos stand in one place, ({}, {}, {}), from which no depth can be told: the scene will look right only from there; correct the poses, or take photos from several places",
                Length(*x),
                Length(*y),
                Length(*z)
            ),
            Self::CamerasInsidePoints { views, near, usual } => write!(
                f,
                "{}: the camera stands among the points: 1 % of them lie within {}, usually it is {}; remove the photo or correct its pose",
                Names(views),
                Length(*near),
                Length(*usual)
            ),
            Self::CamerasFarAway {
                views,
                distance,
                usual,
            } => write!(
                f,
                "{}: the camera is {} from the points, usually it is {}; remove the photo or correct its pose",
                Names(views),
                Length(*distance),
                Length(*usual)
            ),
            Self::CamerasSeeFewPoints {
                views,
                seen,
                points,
            } => write!(
                f,
                "{}: the camera sees {seen} of {points} points; remove the photo or correct its pose (axes: +x right, +y down, +z forward)",
                Names(views)
            ),
            Self::NoisePhotos { views, photos } => write!(
                f,
                "{}: of {photos} photos {} look(s) like noise: neighbouring pixels have nothing in common; look at the files",
                Names(views),
                views.len()
            ),
            Self::HighRates { rates } => {
                for (index, (rate, factor)) in rates.iter().enumerate() {
                    let comma = if index > 0 { ", " } else { "" };
                    let factor = (factor * 100.0).round() / 100.0;
                    write!(f, "{comma}{rate} is {factor} x its default")?;
                }
                write!(f, "; training may not settle, lower the learning rates")
            }
            Self::PhotosChanged { views } => write!(
                f,
                "{}: the photo has other pixels than the one that the run was begun with; it goes on with those there are now",
                Names(views)
            ),
            Self::NoRoomToGrow {
                limit,
                gaussians,
                by_default,
            } => {
                match by_default {
                    true => write!(
                        f,
                        "the default limit of {limit} Gaussians for photos of this number and size"
                    )?,
                    false => write!(f, "--max-gaussians {limit}")?,
                }
                write!(
                    f,
                    " is below the {gaussians} that the run begins with: they are kept, and none is added unless pruning leaves fewer than {limit}"
                )?;
                match by_default {
                    true => write!(
                        f,
                        "; --max-gaussians, a larger `max_gaussians_share` or larger photos make room"
                    ),
                    false => Ok(()),
                }
            }
            Self::SelectionOfFew {
                survivors,
                gaussians,
            } => write!(
                f,
                "the selection keeps {survivors} of the {gaussians} Gaussians that the run begins with; a larger `improved.selection.final_share` or `final_gaussians` keeps more"
            ),
            Self::ShReductionNeverDue => write!(
                f,
                "`sh_reduction` lowers no degrees: the run ends before the highest degree is trained, or before the share `sh_reduction.at` of it; train for more steps, or leave it out"
            ),
            Self::TooFewKeypoints => write!(
                f,
                "the photos have too few keypoints in common to adjust poses to; poses are refined by gradients of the photos alone"
            ),
            Self::KeypointsDoNotFit {
                after,
                rematched: Some(rematched),
                ..
            } => write!(
                f,
                "corners that the photos seem to share do not agree: they are {after:.2} pixels off in the median at best, and {rematched:.2} when they are matched anew, where 0.3 % of the longer side is the most; poses are refined by gradients of the photos alone"
            ),
            Self::KeypointsDoNotFit { before, after, .. } => write!(
                f,
                "the keypoints do not fit these photos and cameras: they are {before:.2} pixels off in the median, and {after:.2} at best; poses are refined by gradients of the photos alone"
            ),
            Self::NotSaved { step, reason } => write!(
                f,
                "at step {step} the run could not be saved: {reason}; it goes on, and tries again"
            ),
            Self::LossNotFinite { view, step } => write!(
                f,
                "{view}: at step {step} the loss is not a finite number; gradients that are not finite are left out, look at the photo, its camera and the loss"
            ),
            Self::HardViews {
                views,
                step,
                loss,
                usual,
            } => write!(
                f,
                "{}: after {step} steps the loss is still {loss:.4}, usually it is {usual:.4}; look at the photo and the pose of its camera",
                Names(views)
            ),
            Self::LossRises { step, loss, least } => write!(
                f,
                "the loss rises: {loss:.4} after {step} steps, it was {least:.4}; lower the learning rates"
            ),
            Self::LossDoesNotFall { step, first, last } => write!(
                f,
                "the loss does not fall: {last:.4} after {step} steps, {first:.4} at the beginning; look at the photos, their cameras and the loss"
            ),
        }
    }
}

/// A length in the capture's unit, formatted with its significant digits at any magnitude.
struct Length(f64);

impl fmt::Display for Length {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0.abs() {
            size if size == 0.0 || (0.1..1e6).contains(&size) => write!(f, "{:.3}", self.0),
            _ => write!(f, "{:.3e}", self.0),
        }
    }
}

/// The first name, and the number of others.
struct Names<'a>(&'a [String]);

impl fmt::Display for Names<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            [] => write!(f, "no photo"),
            [only] => write!(f, "{only}"),
            [first, others @ ..] => write!(f, "{first} and {} other(s)", others.len()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_warning_is_one_line_that_names_photo_and_number() {
        let warning = Warning::HardViews {
            views: vec!["a.jpg".into(), "b.jpg".into()],
            step: 250,
            loss: 0.5,
            usual: 0.1,
        };
        let text = warning.to_string();
        assert!(
            text.starts_with("a.jpg and 1 other(s): after 250 steps"),
            "{text}"
        );
        assert!(text.contains("0.5000") && !text.contains('\n'), "{text}");
        let warning = Warning::HighRates {
            rates: vec![
                ("learning_rates.means".into(), 10.0),
                ("learning_rates.sh0".into(), 7.5),
            ],
        };
        let text = warning.to_string();
        assert!(
            text.starts_with(
                "learning_rates.means is 10 x its default, learning_rates.sh0 is 7.5 x"
            ),
            "{text}"
        );
    }

    #[test]
    fn lengths_can_be_read_in_any_unit() {
        let text = [0.0, 2.0, 123_456.7, 4.2e-6, 3.5e9].map(|length| Length(length).to_string());
        assert_eq!(
            text,
            ["0.000", "2.000", "123456.700", "4.200e-6", "3.500e9"]
        );
    }

    #[test]
    fn nothing_is_said_twice() {
        let hard = |views: &[&str]| Warning::HardViews {
            views: views.iter().map(|view| (*view).to_owned()).collect(),
            step: 1,
            loss: 1.0,
            usual: 0.1,
        };
        let lost = |view: &str, step| Warning::LossNotFinite {
            view: view.to_owned(),
            step,
        };
        let known = [hard(&["a", "b"]), lost("c", 3)];
        assert_eq!(hard(&["b", "d", "a"]).beyond(&known), Some(hard(&["d"])));
        assert_eq!(hard(&["b"]).beyond(&known), None);
        assert_eq!(lost("c", 9).beyond(&known), None);
        assert_eq!(lost("d", 9).beyond(&known), Some(lost("d", 9)));
        let points = |count| Warning::CoincidentPoints { count, points: 9 };
        assert_eq!(points(8).beyond(&known), Some(points(8)));
        assert_eq!(points(8).beyond(&[points(7)]), None);
    }
}
