//! Keypoints, their errors, and the derivatives of these.

use glam::{DMat3, DMat4, DVec3};
use splat_data::{BoundedLens, Capture, View};

use super::FEWEST_KEYPOINTS;
use crate::quantile::median;

/// Differences of a projection are taken over this share of the distance to the camera.
const DIFFERENCE: f64 = 1e-6;

/// A keypoint of a training view.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sight {
    /// Index among the training views.
    pub view: usize,
    /// Index among the points.
    pub point: usize,
    /// On the image plane.
    pub position: [f64; 2],
}

/// The keypoints to agree with.
pub(super) struct Problem<'a> {
    /// Sorted by point.
    pub sights: Vec<Sight>,
    /// Number of training views, and of points.
    pub views: usize,
    pub points: usize,
    cameras: Vec<Camera<'a>>,
}

struct Camera<'a> {
    lens: BoundedLens,
    view: &'a View,
}

impl Camera<'_> {
    /// The error of a point in camera space, in pixels.
    fn error(&self, point: DVec3, [x, y]: [f64; 2]) -> Option<[f64; 2]> {
        let [fx, fy, _, _] = self.view.intrinsics;
        let [a, b] = self.lens.distort(point.to_array())?;
        Some([fx * (a - x), fy * (b - y)])
    }
}

/// What is looked for.
#[derive(Debug, Clone)]
pub(super) struct Unknowns {
    pub viewmats: Vec<DMat4>,
    pub points: Vec<DVec3>,
}

/// A change of all unknowns.
pub(super) struct Step {
    /// Rotation vector and translation in the axes of each camera.
    pub views: Vec<[f64; 6]>,
    pub points: Vec<DVec3>,
}

impl Unknowns {
    pub fn moved(&self, step: &Step) -> Self {
        let view = |(viewmat, [r1, r2, r3, x, y, z]): (&DMat4, &[f64; 6])| {
            let turn = DMat3::from_quat(glam::DQuat::from_scaled_axis(DVec3::new(*r1, *r2, *r3)));
            let mut rigid = DMat4::from_mat3(turn);
            rigid.w_axis = DVec3::new(*x, *y, *z).extend(1.0);
            rigid * *viewmat
        };
        Self {
            viewmats: self.viewmats.iter().zip(&step.views).map(view).collect(),
            points: (self.points.iter().zip(&step.points))
                .map(|(point, shift)| *point + *shift)
                .collect(),
        }
    }
}

/// Distances of keypoints and projected points in pixels; infinite where a point has no projection.
pub(super) struct Errors(Vec<f64>);

impl Errors {
    pub fn median(&self) -> f64 {
        median(self.0.iter().copied())
    }
}

/// Huber's loss: quadratic up to a bound, and linear beyond.
#[derive(Clone, Copy)]
pub(super) struct Cost {
    pub quadratic: f64,
}

impl Cost {
    /// The sum over all keypoints. A point without a projection costs as much as a large error, so
    /// that none is gained by moving it out of the picture.
    pub fn of(self, errors: &Errors) -> f64 {
        let bound = self.quadratic;
        let loss = |error: &f64| {
            let error = error.min(1e3 * bound);
            match error <= bound {
                true => 0.5 * error * error,
                false => bound * (error - 0.5 * bound),
            }
        };
        errors.0.iter().map(loss).sum()
    }

    /// The weight with which least squares have the same gradient.
    pub fn weight(self, error: f64) -> f64 {
        match error <= self.quadratic {
            true => 1.0,
            false => self.quadratic / error,
        }
    }
}

/// One coordinate of an error with its derivatives.
#[derive(Clone, Copy, Default)]
pub(super) struct Row {
    pub error: f64,
    /// By rotation vector and translation of the view.
    pub view: [f64; 6],
    /// By the point.
    pub point: DVec3,
}

/// Errors and derivatives at one place.
pub(super) struct Linearized {
    pub errors: Errors,
    /// Two for each keypoint; zero where a point has no projection.
    pub rows: Vec<[Row; 2]>,
}

impl<'a> Problem<'a> {
    /// The keypoints of a capture, as far as its training views have them.
    pub fn of_capture(capture: &Capture, views: &[&'a View]) -> Option<Self> {
        let mut index_of = vec![None; capture.views.len()];
        for (index, view) in capture.split.train.iter().enumerate() {
            index_of[*view] = Some(index);
        }
        let mut sights: Vec<Sight> = (capture.observations.iter())
            .filter_map(|observation| {
                let point = observation.point as usize;
                Some(Sight {
                    view: (*index_of.get(observation.view as usize)?)?,
                    point: (point < capture.points.len()).then_some(point)?,
                    position: observation.position,
                })
            })
            .collect();
        sights.sort_by_key(|sight| (sight.point, sight.view));
        Self::new(views, capture.points.len(), sights)
    }

    /// Keypoints, sorted by point, of views that have enough of them and of points that two views
    /// share.
    pub fn new(views: &[&'a View], points: usize, mut sights: Vec<Sight>) -> Option<Self> {
        // Each may leave too few of the other behind.
        loop {
            let before = sights.len();
            let mut of_view = vec![0; views.len()];
            for sight in &sights {
                of_view[sight.view] += 1;
            }
            sights.retain(|sight| of_view[sight.view] >= FEWEST_KEYPOINTS);
            let shared = |sights: &[Sight]| sights[0].view != sights[sights.len() - 1].view;
            sights = (sights.chunk_by(|a, b| a.point == b.point))
                .filter(|of_point| shared(of_point))
                .flatten()
                .copied()
                .collect();
            if sights.is_empty() {
                return None;
            }
            if sights.len() == before {
                break;
            }
        }
        let camera = |view: &&'a View| Camera {
            lens: view.lens.bounded(),
            view,
        };
        Some(Self {
            sights,
            views: views.len(),
            points,
            cameras: views.iter().map(camera).collect(),
        })
    }

    /// Number of views that have keypoints.
    pub fn observing_views(&self) -> usize {
        let mut observes = vec![false; self.views];
        for sight in &self.sights {
            observes[sight.view] = true;
        }
        observes.iter().filter(|observes| **observes).count()
    }

    /// The same without keypoints whose error is many times that of the others.
    pub fn without_outliers(&self, unknowns: &Unknowns, times: f64) -> Option<Self> {
        let errors = self.errors(unknowns);
        let most = times * errors.median();
        let kept = self.sights.iter().zip(&errors.0);
        let kept = kept.filter(|(_, error)| **error <= most);
        let views: Vec<&'a View> = self.cameras.iter().map(|camera| camera.view).collect();
        Self::new(&views, self.points, kept.map(|(sight, _)| *sight).collect())
    }

    fn seen(&self, sight: &Sight, unknowns: &Unknowns) -> DVec3 {
        unknowns.viewmats[sight.view].transform_point3(unknowns.points[sight.point])
    }

    pub fn errors(&self, unknowns: &Unknowns) -> Errors {
        let error = |sight: &Sight| {
            let point = self.seen(sight, unknowns);
            let error = self.cameras[sight.view].error(point, sight.position);
            error.map_or(f64::INFINITY, |[x, y]| x.hypot(y))
        };
        Errors(self.sights.iter().map(error).collect())
    }

    /// Errors with their derivatives, which are central differences in camera space: the same for
    /// every lens, and exact to nine digits.
    pub fn linearized(&self, unknowns: &Unknowns) -> Linearized {
        let rows = |sight: &Sight| -> Option<[Row; 2]> {
            let point = self.seen(sight, unknowns);
            let camera = &self.cameras[sight.view];
            let error = camera.error(point, sight.position)?;
            let h = DIFFERENCE * point.length();
            let mut by_point = [DVec3::ZERO; 2];
            for axis in 0..3 {
                let mut shift = DVec3::ZERO;
                shift[axis] = h;
                let [ahead, behind] = [point + shift, point - shift];
                let ahead = camera.error(ahead, sight.position)?;
                let behind = camera.error(behind, sight.position)?;
                for row in 0..2 {
                    by_point[row][axis] = (ahead[row] - behind[row]) / (2.0 * h);
                }
            }
            let turn = DMat3::from_mat4(unknowns.viewmats[sight.view]);
            Some([0, 1].map(|row| {
                let d = by_point[row];
                let [r1, r2, r3] = point.cross(d).to_array();
                Row {
                    error: error[row],
                    view: [r1, r2, r3, d.x, d.y, d.z],
                    point: turn.transpose() * d,
                }
            }))
        };
        Linearized {
            errors: self.errors(unknowns),
            rows: (self.sights.iter())
                .map(|sight| rows(sight).unwrap_or_default())
                .collect(),
        }
    }
}
