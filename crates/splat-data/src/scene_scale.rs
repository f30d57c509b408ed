//! The size of a scene: the unit of all other lengths in training, rendering and checks.
//!
//! A capture has no unit: structure from motion leaves the scale open, and the same photos may come
//! in metres, millimetres or anything else. Therefore no length may be a constant. The lengths, and
//! what they follow:
//!
//! | length | value |
//! |---|---|
//! | near and far plane | [`SceneScale::near`], [`SceneScale::far`] |
//! | step of the means | learning rate x [`SceneScale::length`] (`Field::rate_at`) |
//! | epsilon of the means' Adam, one over a length | [`SceneScale::means_epsilon`] |
//! | sizes at which Gaussians split and are pruned | shares of [`SceneScale::length`] (`AdcSettings`) |
//! | first scales | distances of the points; where all coincide, [`SceneScale::length`] (`splats_from_points`) |
//! | distance beyond which coordinates are relative to an origin | [`SceneScale::origin`] |
//! | thresholds of warnings | distances between the capture's own cameras and points |
//! | orbit of `splat render` | the spread of the scene's own Gaussians, or else [`SceneScale::length`] |
//!
//! The remaining absolute lengths: [`ProjectSettings::near`](splat_core::ProjectSettings::near) and
//! `far` of the bare op, whose caller knows the unit (0.01 and 1e10, as in gsplat); lengths in
//! pixels (the low-pass filter, the largest size of a splat); the sizes that fit single precision,
//! 1e-15 to 1e10; and 1, the size of a degenerate scene (one camera at the position of its points).

use glam::DVec3;
use splat_core::ProjectSettings;

use crate::Camera;
use crate::SplatData;

/// The size of a scene in world units: positive and finite.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
pub struct SceneScale(f64);

impl SceneScale {
    /// Near plane, as a share of the scene's size. 3DGS culls what is nearer than 0.2 of COLMAP's
    /// units, 0.03 to 0.05 of the size of its scenes; gsplat 0.01 of a normalised world. A Gaussian
    /// between the two covers the whole picture, and no photo was taken through one.
    const NEAR: f64 = 0.03;
    /// Far plane, in sizes of the scene (gsplat).
    const FAR: f64 = 1e10;
    /// Adam's epsilon of 3DGS, in a scene of size 1.
    const EPSILON: f64 = 1e-15;
    /// Distance from the world's zero, in sizes of the scene, beyond which single precision
    /// resolves less than 1e-5 of the size.
    const ORIGIN_FROM: f64 = 100.0;
    /// Most points used for the distance of a camera.
    const POINTS: usize = 4096;

    /// Sizes that can be trained in single precision; beyond these, squares of gradients and sizes
    /// leave its range. Tested from 1e-15 to 1e9.
    const TRAINABLE: core::ops::RangeInclusive<f64> = 1e-15..=1e10;

    /// True if a scene of this size can be trained and rendered in single precision.
    pub fn is_in_range(self) -> bool {
        Self::TRAINABLE.contains(&self.0)
    }

    /// A scene of this size; `None` unless positive and finite.
    pub fn new(length: f64) -> Option<Self> {
        (length > 0.0 && length.is_finite()).then_some(Self(length))
    }

    /// Size of a capture: the median over cameras of each camera's median distance to the points,
    /// roughly the viewing distance.
    ///
    /// 3DGS uses 1.1 times the largest distance of a camera from the mean camera, which is nearly
    /// the same for cameras all around a scene (0.8 to 1.2 times this on seven captures). But one
    /// wrong camera can make that maximum arbitrary, whereas medians move by a few percent at most
    /// if a tenth of the cameras or points are arbitrary.
    ///
    /// ```
    /// use splat_data::{Camera, ImageSize, Lens, SceneScale};
    ///
    /// let camera = |x: f64| Camera {
    ///     viewmat: glam::DMat4::from_translation(glam::DVec3::new(-x, 0.0, 0.0)),
    ///     intrinsics: [50.0, 50.0, 32.0, 24.0],
    ///     lens: Lens::Pinhole,
    ///     size: ImageSize { width: 64, height: 48 },
    /// };
    /// let cameras = [-0.1, 0.0, 0.1, 0.2, 3_000.0].map(camera);
    /// let scale = SceneScale::of_capture(&cameras, &[[0.0, 0.0, 4.0]]);
    /// assert!((scale.length() - 4.0).abs() < 0.01);
    /// ```
    pub fn of_capture(cameras: &[Camera], points: &[[f64; 3]]) -> Self {
        let every = points.len().div_ceil(Self::POINTS).max(1);
        let points: Vec<DVec3> = points
            .iter()
            .step_by(every)
            .copied()
            .map(DVec3::from)
            .collect();
        let centers: Vec<DVec3> = cameras.iter().map(Camera::position).collect();
        let from = |center: &DVec3| median(points.iter().map(|point| point.distance(*center)));
        Self::new(median(centers.iter().map(from)))
            .or_else(|| Self::of_positions(centers))
            .unwrap_or(Self(1.0))
    }

    /// Size of a scene of which only the Gaussians are known: the median distance of the means from
    /// their median, or the median of their own sizes if all are in one place.
    pub fn of_splats(splats: &SplatData) -> Self {
        let every = splats.len().div_ceil(Self::POINTS).max(1);
        let means = splats.means.iter().step_by(every);
        let means = means.map(|mean| DVec3::from(mean.map(f64::from)));
        let largest = |scales: &[f32; 3]| f64::from(scales[0].max(scales[1]).max(scales[2])).exp();
        let own = || Self::new(median(splats.log_scales.iter().map(largest)));
        Self::of_positions(means.collect())
            .or_else(own)
            .unwrap_or(Self(1.0))
    }

    fn of_positions(positions: Vec<DVec3>) -> Option<Self> {
        let middle = middle(&positions);
        Self::new(median(positions.iter().map(|at| at.distance(middle))))
    }

    /// The size in world units.
    pub fn length(self) -> f64 {
        self.0
    }

    /// Distance of the near plane in world units.
    pub fn near(self) -> f64 {
        Self::NEAR * self.0
    }

    /// Distance of the far plane in world units.
    pub fn far(self) -> f64 {
        Self::FAR * self.0
    }

    /// Default settings of the projection, with the near and far plane of this scene.
    pub fn project_settings(self) -> ProjectSettings {
        ProjectSettings {
            near: self.near(),
            far: self.far(),
            ..ProjectSettings::default()
        }
    }

    /// Adam's epsilon for the means. It is added to the magnitude of a gradient, which is one over
    /// a length: with a constant, the same scene would train differently in another unit.
    pub fn means_epsilon(self) -> f64 {
        Self::EPSILON / self.0
    }

    /// Origin for the means of the scene: the world's zero, unless that is so far away that 32-bit
    /// floats would lose visible detail. Then it is the median of the cameras, rounded to a power
    /// of two below the scene's size.
    pub fn origin(self, cameras: &[Camera]) -> [f64; 3] {
        let positions: Vec<DVec3> = cameras.iter().map(Camera::position).collect();
        let middle = middle(&positions);
        if middle.abs().max_element() > Self::ORIGIN_FROM * self.0 {
            let unit = self.0.log2().floor().exp2();
            ((middle / unit).round() * unit).to_array()
        } else {
            [0.0; 3]
        }
    }
}

/// Median of each axis; zero for no positions.
fn middle(positions: &[DVec3]) -> DVec3 {
    let axis = |axis: usize| match positions {
        [] => 0.0,
        _ => median(positions.iter().map(|position| position[axis])),
    };
    DVec3::new(axis(0), axis(1), axis(2))
}

/// The middle value, or the mean of the two middle values; NaN for no values.
fn median(values: impl IntoIterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.into_iter().collect();
    let half = values.len() / 2;
    if values.is_empty() {
        return f64::NAN;
    }
    let is_even = values.len().is_multiple_of(2);
    let (below, upper, _) = values.select_nth_unstable_by(half, f64::total_cmp);
    match below.iter().copied().max_by(f64::total_cmp) {
        Some(lower) if is_even => (lower + *upper) / 2.0,
        _ => *upper,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    fn camera(at: DVec3) -> Camera {
        Camera {
            viewmat: glam::DMat4::from_translation(-at),
            intrinsics: [50.0, 50.0, 8.0, 8.0],
            lens: splat_core::Lens::Pinhole,
            size: splat_core::ImageSize {
                width: 16,
                height: 16,
            },
        }
    }

    fn draw(rng: &mut Pcg64Mcg, spread: f64) -> DVec3 {
        DVec3::from([(); 3].map(|()| rng.random_range(-spread..spread)))
    }

    /// Cameras around a scene, in a row in front of it, and on a walk through it, each with its
    /// points.
    fn captures(rng: &mut Pcg64Mcg) -> [(Vec<DVec3>, Vec<[f64; 3]>); 3] {
        let mut points = |at: DVec3, spread: f64| -> Vec<[f64; 3]> {
            (0..3_000)
                .map(|_| (at + draw(rng, spread)).to_array())
                .collect()
        };
        let around = |i: usize| {
            let angle = i as f64 * 0.37;
            DVec3::new(
                4.0 * angle.cos(),
                0.5 * (3.0 * angle).sin(),
                4.0 * angle.sin(),
            )
        };
        let in_a_row = |i: usize| DVec3::new(i as f64 / 40.0 - 0.5, 0.0, 0.0);
        let on_a_walk = |i: usize| DVec3::new(i as f64 / 10.0 - 2.0, 0.0, (i as f64 / 7.0).sin());
        [
            ((0..40).map(around).collect(), points(DVec3::ZERO, 1.0)),
            ((0..40).map(in_a_row).collect(), points(DVec3::Z * 6.0, 2.0)),
            ((0..40).map(on_a_walk).collect(), points(DVec3::ZERO, 5.0)),
        ]
    }

    /// Promise: a tenth of the cameras may be arbitrary.
    #[test]
    fn a_tenth_of_the_cameras_hardly_moves_the_scale() {
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        let scale = |centers: &[DVec3], points: &[[f64; 3]]| {
            let cameras: Vec<Camera> = centers.iter().copied().map(camera).collect();
            SceneScale::of_capture(&cameras, points).length()
        };
        for (kind, (centers, points)) in captures(&mut rng).into_iter().enumerate() {
            let before = scale(&centers, &points);
            for away in [0.0, 0.01, 0.3, 1.0, 2.0, 5.0, 100.0, 3_000.0, 1e9] {
                for _ in 0..20 {
                    let mut centers = centers.clone();
                    for _ in 0..centers.len() / 10 {
                        let at = rng.random_range(0..centers.len());
                        centers[at] = draw(&mut rng, 1.0) * away;
                    }
                    let change = scale(&centers, &points) / before - 1.0;
                    assert!(
                        change.abs() < 0.05,
                        "capture {kind}, {away} away: {:.1} %",
                        100.0 * change
                    );
                }
            }
        }
    }

    #[test]
    fn every_length_follows_the_unit() {
        let mut rng = Pcg64Mcg::seed_from_u64(6);
        for (centers, points) in captures(&mut rng) {
            let of = |unit: f64| {
                let cameras: Vec<Camera> = centers.iter().map(|at| camera(*at * unit)).collect();
                let points: Vec<[f64; 3]> = points.iter().map(|p| p.map(|x| x * unit)).collect();
                SceneScale::of_capture(&cameras, &points)
            };
            let base = of(1.0);
            for unit in [1e-6, 0.002, 0.5, 1e6] {
                let scale = of(unit);
                for (ours, expected) in [
                    (scale.length(), unit * base.length()),
                    (scale.near(), unit * base.near()),
                    (scale.far(), unit * base.far()),
                    (scale.means_epsilon(), base.means_epsilon() / unit),
                ] {
                    assert!(
                        (ours / expected - 1.0).abs() < 1e-12,
                        "{unit}: {ours} {expected}"
                    );
                }
            }
        }
    }

    #[test]
    fn only_a_scene_far_from_zero_gets_an_origin() {
        let origin = |positions: &[[f64; 2]], unit: f64| {
            let at = |p: &[f64; 2]| camera(DVec3::new(p[0], p[1], 0.0) * unit);
            let cameras: Vec<Camera> = positions.iter().map(at).collect();
            SceneScale::new(1.5 * unit).unwrap().origin(&cameras)
        };
        let near = [[0.0, 3.0], [2.0, 3.0], [4.0, 50.0]];
        let far = [[4e6, 3.25], [4e6 + 2.0, 3.5]];
        assert_eq!(origin(&near, 1.0), [0.0; 3]);
        assert_eq!(origin(&far, 1.0), [4_000_001.0, 3.0, 0.0]);
        // One wrong camera does not move the scene.
        let one_off = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [1e9, 0.0]];
        assert_eq!(origin(&one_off, 1.0), [0.0; 3]);
        // The same in any unit, up to the rounding to a power of two.
        for unit in [1e-6, 1e6] {
            let [x, _, _] = origin(&far, unit);
            assert!((x / unit - 4_000_001.0).abs() <= 2.0, "{x}");
        }
    }

    #[test]
    fn there_is_always_a_scale() {
        let one = [camera(DVec3::ZERO)];
        assert_eq!(SceneScale::of_capture(&one, &[[0.0; 3]]).length(), 1.0);
        assert_eq!(
            SceneScale::of_capture(&one, &[[0.0, 3.0, 4.0]]).length(),
            5.0
        );
        assert_eq!(SceneScale::of_capture(&[], &[]).length(), 1.0);
        assert_eq!(SceneScale::of_splats(&SplatData::default()).length(), 1.0);
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert_eq!(SceneScale::new(bad), None);
        }
    }
}
