//! Cameras.

use glam::{DMat4, DVec3};
use splat_core::{ImageSize, Lens};

/// A camera: axes +x right, +y down, +z forward (OpenCV, COLMAP).
///
/// ```
/// use glam::{DMat4, DVec3};
/// use splat_data::{Camera, ImageSize, Lens};
///
/// let camera = Camera {
///     viewmat: DMat4::from_translation(DVec3::new(0.0, 0.0, 2.0)),
///     intrinsics: [50.0, 50.0, 32.0, 24.0],
///     lens: Lens::Pinhole,
///     size: ImageSize { width: 64, height: 48 },
/// };
/// assert_eq!(camera.position(), DVec3::new(0.0, 0.0, -2.0));
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// World to camera.
    pub viewmat: DMat4,
    /// fx, fy, cx, cy in pixels; the centre of the first pixel is at (0.5, 0.5).
    pub intrinsics: [f64; 4],
    /// Camera model and distortion.
    pub lens: Lens,
    /// Image size in pixels.
    pub size: ImageSize,
}

impl Camera {
    /// Position of the camera in the world.
    pub fn position(&self) -> DVec3 {
        let [r0, r1, r2] = [0, 1, 2].map(|i| self.viewmat.row(i));
        -(r0.truncate() * r0.w + r1.truncate() * r1.w + r2.truncate() * r2.w)
    }

    /// The same camera in a world with its origin at `origin`. Call it before converting to
    /// tensors: in double precision the difference of two large coordinates is exact.
    pub fn relative_to(&self, origin: [f64; 3]) -> Self {
        Self {
            viewmat: self.viewmat * DMat4::from_translation(DVec3::from(origin)),
            ..*self
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    #[test]
    fn position_is_what_the_camera_sees_at_its_origin() {
        let rotation = DQuat::from_euler(glam::EulerRot::XYZ, 0.3, -0.7, 1.1);
        let viewmat = DMat4::from_rotation_translation(rotation, DVec3::new(1.0, -2.0, 3.0));
        let camera = Camera {
            viewmat,
            intrinsics: [500.0, 500.0, 50.0, 50.0],
            lens: Lens::Pinhole,
            size: ImageSize {
                width: 100,
                height: 100,
            },
        };
        let seen = viewmat.transform_point3(camera.position());
        assert!(seen.length() < 1e-12, "{seen}");

        let (origin, point) = (DVec3::new(4e6, -5e5, 1e3), DVec3::new(0.5, -2.0, 7.0));
        let local = camera.relative_to(origin.to_array());
        let seen = local.viewmat.transform_point3(point);
        assert!((seen - viewmat.transform_point3(origin + point)).length() < 1e-8);
    }
}
