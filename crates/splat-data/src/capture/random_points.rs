//! Random points for captures without points from structure from motion.

use glam::{DMat3, DVec3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::{CaptureWarning, Point};
use crate::Camera;

/// Number of points, that of the 3DGS paper's code for synthetic scenes.
pub(super) const COUNT: usize = 100_000;

/// A cube: its centre, and half of its side.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Room {
    pub center: DVec3,
    pub half_side: f64,
}

impl Room {
    /// The cube of the 3DGS paper's code for Blender captures.
    pub const BLENDER: Self = Self {
        center: DVec3::ZERO,
        half_side: 1.3,
    };

    /// The cube about the point nearest to all optical axes, in the sense of least squares, up to
    /// the median distance of the cameras.
    ///
    /// Where the axes are nearly parallel, or meet behind most cameras, no such point is
    /// meaningful. The cube then begins at the middle of the cameras and extends in their mean
    /// direction by twice their spread, or 1 if that is zero.
    pub fn of_cameras(cameras: &[Camera]) -> Self {
        let positions: Vec<DVec3> = cameras.iter().map(Camera::position).collect();
        let forward = |camera: &Camera| camera.viewmat.row(2).truncate().normalize_or_zero();
        let axes: Vec<DVec3> = cameras.iter().map(forward).collect();
        let meeting = meeting(&positions, &axes).filter(|point| {
            let ahead = |(position, axis): (&DVec3, &DVec3)| axis.dot(point - position) > 0.0;
            2 * positions
                .iter()
                .zip(&axes)
                .filter(|pair| ahead(*pair))
                .count()
                > positions.len()
        });
        let about = |center: DVec3| {
            let half_side = median(positions.iter().map(|p| p.distance(center)));
            Some(Self { center, half_side }).filter(Self::is_usable)
        };
        meeting.and_then(about).unwrap_or_else(|| {
            let middle = middle(&positions);
            let spread = median(positions.iter().map(|p| p.distance(middle)));
            let half_side = 2.0
                * if spread > 0.0 && spread.is_finite() {
                    spread
                } else {
                    0.5
                };
            let ahead = axes.iter().sum::<DVec3>().normalize_or_zero();
            let center = middle + ahead * half_side;
            let room = Self { center, half_side };
            if room.is_usable() {
                room
            } else {
                Self::BLENDER
            }
        })
    }

    fn is_usable(&self) -> bool {
        let far = self.center.abs().max_element();
        self.half_side > 0.0 && self.half_side < 1e100 && far < 1e100
    }

    /// The warning that points in this cube replace the capture's own.
    pub fn warning(self) -> CaptureWarning {
        CaptureWarning::RandomPoints {
            count: COUNT,
            center: self.center.to_array(),
            half_side: self.half_side,
        }
    }
}

/// Uniformly random points in the cube with uniformly random colours, always the same ones.
pub(super) fn draw(room: Room, count: usize) -> Vec<Point> {
    let mut rng = Pcg64Mcg::seed_from_u64(0);
    let mut point = || {
        let offset = DVec3::from_array(core::array::from_fn(|_| rng.random_range(-1.0..1.0)));
        Point {
            position: (room.center + room.half_side * offset).to_array(),
            color: core::array::from_fn(|_| rng.random_range(0..=255)),
        }
    };
    (0..count).map(|_| point()).collect()
}

/// The point with the least sum of squared distances from the axes; `None` if they are nearly
/// parallel.
fn meeting(positions: &[DVec3], axes: &[DVec3]) -> Option<DVec3> {
    // Relative to the cameras, so that distant coordinates cost no precision.
    let middle = middle(positions);
    let mut matrix = DMat3::ZERO;
    let mut sum = DVec3::ZERO;
    for (position, axis) in positions.iter().zip(axes) {
        // Projection to the plane across the axis.
        let across =
            DMat3::IDENTITY - DMat3::from_cols(axis * axis.x, axis * axis.y, axis * axis.z);
        matrix += across;
        sum += across * (position - middle);
    }
    // Of the mean, the determinant is at most 8/27; for axes within 3 degrees below 0.003.
    let mean = matrix * (1.0 / positions.len() as f64);
    let point = middle + matrix.inverse() * sum;
    (mean.determinant() > 0.003 && point.is_finite()).then_some(point)
}

fn middle(positions: &[DVec3]) -> DVec3 {
    let of = |axis: fn(&DVec3) -> f64| median(positions.iter().map(axis));
    DVec3::new(of(|p| p.x), of(|p| p.y), of(|p| p.z))
}

/// The median; 0 of nothing.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use glam::DMat4;
    use splat_core::{ImageSize, Lens};

    use super::*;

    fn looking(from: DVec3, direction: DVec3) -> Camera {
        let up = if direction.y.abs() < 0.9 {
            DVec3::Y
        } else {
            DVec3::X
        };
        let right = direction.cross(up).normalize();
        let down = direction.normalize().cross(right);
        let rotation = DMat3::from_cols(right, down, direction.normalize()).transpose();
        Camera {
            viewmat: DMat4::from_mat3(rotation) * DMat4::from_translation(-from),
            intrinsics: [50.0, 50.0, 32.0, 24.0],
            lens: Lens::Pinhole,
            size: ImageSize {
                width: 64,
                height: 48,
            },
        }
    }

    #[test]
    fn the_cube_is_where_the_cameras_look() {
        let target = DVec3::new(1e4, -3.0, 7.0);
        let ring = |turn: f64| DVec3::new(turn.cos(), 0.3 * turn.sin(), turn.sin()) * 5.0;
        let cameras: Vec<Camera> = (0..12)
            .map(|i| looking(target + ring(f64::from(i) * 0.5), -ring(f64::from(i) * 0.5)))
            .collect();
        let room = Room::of_cameras(&cameras);
        assert!(room.center.distance(target) < 1e-9, "{room:?}");
        assert!((room.half_side - 5.0).abs() < 0.3, "{room:?}");
        let points = draw(room, 1_000);
        assert_eq!(points, draw(room, 1_000));
        let offset = |p: &Point| (DVec3::from(p.position) - target).abs().max_element();
        assert!(points.iter().all(|p| offset(p) <= room.half_side));
        let mean = points
            .iter()
            .map(|p| DVec3::from(p.position))
            .sum::<DVec3>()
            / 1e3;
        assert!(mean.distance(target) < 0.1 * room.half_side);
    }

    #[test]
    fn parallel_or_outward_axes_have_a_cube_ahead() {
        let row = |i: i32| looking(DVec3::new(f64::from(i), 0.0, 0.0), DVec3::Z);
        let cameras: Vec<Camera> = (-3..=3).map(row).collect();
        let room = Room::of_cameras(&cameras);
        assert!(
            room.center.z > 0.0 && room.center.x.abs() < 1e-12,
            "{room:?}"
        );
        assert_eq!(room.half_side, 4.0);
        // From the middle outwards, as in a panorama: around the cameras.
        let out = |i: i32| {
            let turn = f64::from(i) * 0.5;
            let axis = DVec3::new(turn.cos(), 0.0, turn.sin());
            looking(axis, axis)
        };
        let cameras: Vec<Camera> = (0..12).map(out).collect();
        let room = Room::of_cameras(&cameras);
        assert!(
            room.center.length() < 2.5 && room.half_side > 1.0,
            "{room:?}"
        );
        // One camera has no spread.
        let room = Room::of_cameras(&cameras[..1]);
        assert_eq!(room.half_side, 1.0);
    }
}
