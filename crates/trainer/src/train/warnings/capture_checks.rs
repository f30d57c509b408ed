//! Checks before the first step: points, cameras, photos, settings.

use std::collections::HashSet;

use glam::DVec3;
use rayon::prelude::*;
use splat_data::SplatData;

use super::Warning;
use crate::quantile::{median, quantile};
use crate::train::TrainSettings;
use splat_data::{Capture, View};

/// Share of coincident points from which a warning is issued; double matches are a few percent.
const COINCIDENT: f64 = 0.5;
/// Share of the cameras' distance within which half of the points lie: below a tenth of a degree, a
/// few pixels of a photo, nothing can be seen of them.
const COMPACT: f64 = 1e-3;
/// Median standard deviation relative to the cameras' distance. A splat is visible over about three
/// standard deviations to either side, so at a quarter it is wider than a picture of 70 degrees;
/// points of real captures give about 0.005.
const LARGE: f64 = 0.25;
/// Largest distance of cameras from the first one, relative to that of the points, at which they
/// stand in one place: a point shifts by about a tenth of a pixel, at most, in photos with a focal
/// length of ten thousand. Copies of one position differ by rounding only.
const ONE_PLACE: f64 = 1e-5;
/// Smallest number of cameras that are compared; among fewer, none is typical.
const COMPARABLE: usize = 4;
/// A camera is among the points if the nearest percent is closer than this share of the usual
/// distance (real captures stay above 0.4), and half of the points closer than [`INSIDE_MIDDLE`] of
/// theirs. A close-up meets only the first condition; cameras in a room meet neither, being all
/// alike.
const INSIDE_NEAR: f64 = 0.25;
/// See [`INSIDE_NEAR`].
const INSIDE_MIDDLE: f64 = 0.6;
/// Multiple of the usual distance from which a camera is far away; real captures stay below 1.3.
const FAR: f64 = 5.0;
/// Share of the usual number of points below which a camera sees few; real captures stay above
/// 0.35.
const FEW: f64 = 0.1;
/// Correlation of neighbouring pixels below which a photo is noise. Noise has 0 within 0.05; photos
/// of real scenes have 0.6 or more, even at an eighth of their size.
const NOISE: f64 = 0.2;
/// Rows of a photo examined for noise.
const NOISE_ROWS: u32 = 64;
/// Multiple of the default from which a rate is high: more than tuning to a scene needs.
const HIGH_RATE: f64 = 5.0;

/// All warnings about the capture and the settings.
pub(in crate::train) fn inspect(
    capture: &Capture,
    splats: &SplatData,
    config: &TrainSettings,
) -> Vec<Warning> {
    let positions: Vec<DVec3> = capture
        .points
        .iter()
        .map(|point| DVec3::from_array(point.position))
        .collect();
    let outlooks: Vec<Outlook> = capture
        .views
        .par_iter()
        .map(|view| Outlook::of(view, &positions))
        .collect();
    let distance = median(outlooks.iter().map(|outlook| outlook.middle));
    let mut warnings = Vec::new();
    warnings.extend(crowded(&positions, splats.origin.into(), distance));
    warnings.extend(large(splats, config, distance));
    warnings.extend(one_place(capture, distance));
    warnings.extend(cameras(capture, &outlooks));
    warnings.extend(noise(&capture.views));
    warnings.extend(high_rates(config));
    warnings
}

/// The points as seen by one camera.
struct Outlook {
    /// Distance that includes 1 % of the points.
    near: f64,
    /// Distance that includes half of the points.
    middle: f64,
    /// Number of points that fall into the photo.
    seen: usize,
}

impl Outlook {
    fn of(view: &View, positions: &[DVec3]) -> Self {
        let center = view.camera().position();
        let distances: Vec<f64> = positions.iter().map(|p| p.distance(center)).collect();
        let project = view.projection();
        let seen = |position: &&DVec3| {
            let Some(([x, y], _)) = project(position.to_array()) else {
                return false;
            };
            let inside = |at: f64, side: u32| at > 0.0 && at < f64::from(side);
            inside(x, view.width) && inside(y, view.height)
        };
        Self {
            near: quantile(distances.iter().copied(), 0.01),
            middle: median(distances),
            seen: positions.iter().filter(seen).count(),
        }
    }
}

fn crowded(positions: &[DVec3], origin: DVec3, distance: f64) -> Option<Warning> {
    let points = positions.len();
    // As in the model: relative to its origin and in single precision.
    let places: HashSet<_> = positions
        .iter()
        .map(|p| (*p - origin).as_vec3().to_array().map(f32::to_bits))
        .collect();
    let count = points - places.len();
    if count as f64 >= COINCIDENT * points as f64 {
        return Some(Warning::CoincidentPoints { count, points });
    }
    let axis = |get: fn(&DVec3) -> f64| median(positions.iter().map(get));
    let middle = DVec3::new(axis(|p| p.x), axis(|p| p.y), axis(|p| p.z));
    let radius = median(positions.iter().map(|p| p.distance(middle)));
    // One or two points have no extent to judge.
    (points > 2 && radius < COMPACT * distance)
        .then_some(Warning::CompactPoints { radius, distance })
}

fn large(splats: &SplatData, config: &TrainSettings, distance: f64) -> Option<Warning> {
    let log_scales = &splats.log_scales;
    let largest = |scales: &[f32; 3]| f64::from(scales.iter().copied().fold(f32::MIN, f32::max));
    let scale = median(log_scales.iter().map(largest)).exp();
    (scale > LARGE * distance).then_some(Warning::LargeGaussians {
        scale,
        distance,
        init_scale: config.init.scale,
    })
}

/// Photos from one place show no parallax, from which alone a scene is found. A single photo is not
/// meant to give one.
fn one_place(capture: &Capture, distance: f64) -> Option<Warning> {
    let positions: Vec<DVec3> = capture
        .train_views()
        .map(|view| view.camera().position())
        .collect();
    let (first, others) = positions.split_first()?;
    let is_there = |position: &DVec3| position.distance(*first) <= ONE_PLACE * distance;
    (!others.is_empty() && others.iter().all(is_there)).then(|| Warning::CamerasInOnePlace {
        views: positions.len(),
        place: first.to_array(),
    })
}

/// Reports each odd camera once: for its position, or else for what it sees.
fn cameras(capture: &Capture, outlooks: &[Outlook]) -> Vec<Warning> {
    if outlooks.len() < COMPARABLE {
        return Vec::new();
    }
    let points = capture.points.len();
    let usual = |get: fn(&Outlook) -> f64| median(outlooks.iter().map(get));
    let usual_near = usual(|outlook| outlook.near);
    let usual_middle = usual(|outlook| outlook.middle);
    let usual_seen = usual(|outlook| outlook.seen as f64);
    let inside =
        |o: &Outlook| o.near < INSIDE_NEAR * usual_near && o.middle < INSIDE_MIDDLE * usual_middle;
    let far = |o: &Outlook| o.middle > FAR * usual_middle;
    let few = |o: &Outlook| o.seen == 0 || (o.seen as f64) < FEW * usual_seen;

    let find = |odd: &dyn Fn(&Outlook) -> bool| {
        let found: Vec<usize> = (0..outlooks.len()).filter(|i| odd(&outlooks[*i])).collect();
        let first = found.first().map(|first| &outlooks[*first])?;
        let name = |index: &usize| capture.views[*index].name.clone();
        Some((found.iter().map(name).collect(), first))
    };
    let mut warnings = Vec::new();
    warnings.extend(find(&inside).map(|(views, first)| {
        let (near, usual) = (first.near, usual_near);
        Warning::CamerasInsidePoints { views, near, usual }
    }));
    warnings.extend(find(&far).map(|(views, first)| Warning::CamerasFarAway {
        views,
        distance: first.middle,
        usual: usual_middle,
    }));
    let only_few = |o: &Outlook| few(o) && !inside(o) && !far(o);
    warnings.extend(find(&only_few).map(|(views, first)| {
        let seen = first.seen;
        Warning::CamerasSeeFewPoints {
            views,
            seen,
            points,
        }
    }));
    warnings
}

fn noise(views: &[View]) -> Option<Warning> {
    let noisy: Vec<bool> = views.par_iter().map(is_noise).collect();
    let names = views.iter().zip(noisy).filter(|(_, noisy)| *noisy);
    let noisy: Vec<String> = names.map(|(view, _)| view.name.clone()).collect();
    (!noisy.is_empty()).then_some(Warning::NoisePhotos {
        views: noisy,
        photos: views.len(),
    })
}

/// True if neighbours in a row of the photo's green channel are uncorrelated. A photo of one colour
/// is not noise.
fn is_noise(view: &View) -> bool {
    // A photo that cannot be read ends the run with an error of its own.
    let Ok(view) = view.loaded() else {
        return false;
    };
    let width = view.width as usize;
    let every = (view.height / NOISE_ROWS).max(1) as usize;
    let rows: Vec<Vec<f64>> = view
        .image
        .chunks_exact(3 * width)
        .step_by(every)
        .map(|row| row.chunks_exact(3).map(|rgb| f64::from(rgb[1])).collect())
        .collect();
    let count = (rows.len() * width) as f64;
    let mean = rows.iter().flatten().sum::<f64>() / count;
    let variance = rows
        .iter()
        .flatten()
        .map(|x| (x - mean).powi(2))
        .sum::<f64>()
        / count;
    let pairs = rows.iter().flat_map(|row| row.windows(2));
    let covariance = pairs.map(|p| (p[0] - mean) * (p[1] - mean)).sum::<f64>()
        / (rows.len() * (width - 1)) as f64;
    // Variance of half an 8-bit level; less is a flat photo with rounding.
    variance > 0.25 && covariance < NOISE * variance
}

fn high_rates(config: &TrainSettings) -> Option<Warning> {
    let rates: Vec<(String, f64)> = config
        .learning_rates
        .factors()
        .into_iter()
        .filter(|(_, factor)| *factor >= HIGH_RATE)
        .map(|(name, factor)| (format!("learning_rates.{name}"), factor))
        .collect();
    (!rates.is_empty()).then_some(Warning::HighRates { rates })
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use splat_data::{Camera, CaptureSettings};

    use super::*;

    fn example() -> Capture {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/data/saharov");
        Capture::load(folder, &CaptureSettings::new().with_downscale(16)).unwrap()
    }

    /// The view with its camera at another position.
    fn moved(view: &View, to: DVec3) -> View {
        let camera = view.camera();
        let shift = camera.position() - to;
        view.with_pose(&Camera {
            viewmat: camera.viewmat * glam::DMat4::from_translation(shift),
            ..camera
        })
    }

    #[test]
    fn cameras_that_all_stand_in_one_place_are_told() {
        let distance = 5.0;
        let mut capture = example();
        assert_eq!(one_place(&capture, distance), None);
        // In different directions, and far from the origin.
        let place = DVec3::new(0.1, -2000.3, 7.7);
        for index in capture.split.train.clone() {
            capture.views[index] = moved(&capture.views[index], place);
        }
        let Some(warning) = one_place(&capture, distance) else {
            panic!("no warning");
        };
        let count = capture.split.train.len();
        let Warning::CamerasInOnePlace { views, place: told } = &warning else {
            panic!("another warning: {warning}");
        };
        assert_eq!(*views, count);
        assert!(DVec3::from_array(*told).distance(place) < 1e-9, "{told:?}");
        let message = warning.to_string();
        for word in [&*format!("all {count} training"), "-2000.300", "poses"] {
            assert!(message.contains(word), "{message}");
        }

        // A short way to the side is enough for depth.
        let last = capture.split.train[count - 1];
        capture.views[last] = moved(&capture.views[last], place + DVec3::X * 0.01);
        assert_eq!(one_place(&capture, distance), None);
        // One photo alone is no matter of places.
        capture.split.train = vec![last];
        assert_eq!(one_place(&capture, distance), None);
    }
}
