//! The records of a COLMAP model as both of its encodings store them.

use splat_core::Lens;

use super::Point;
use super::colmap_models::Layout;

/// A camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ColmapCamera {
    pub id: u32,
    pub width: u32,
    pub height: u32,
    /// `[fx, fy, cx, cy]` in pixels, pixel centres at + 0.5.
    pub intrinsics: [f64; 4],
    pub lens: Lens,
}

impl ColmapCamera {
    /// A camera from its parameters, as many as `layout` has.
    pub fn new(id: u32, [width, height]: [u32; 2], layout: Layout, parameters: &[f64]) -> Self {
        let (intrinsics, lens) = layout.camera(parameters);
        Self {
            id,
            width,
            height,
            intrinsics,
            lens,
        }
    }
}

/// A point with the id by which keypoints refer to it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ColmapPoint {
    pub id: u64,
    pub point: Point,
}

/// A keypoint of an image that was matched with a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ColmapKeypoint {
    /// In pixels of the camera, pixel centres at + 0.5.
    pub position: [f64; 2],
    pub point_id: u64,
}

/// A registered image.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ColmapImage {
    pub id: u32,
    pub camera_id: u32,
    pub name: String,
    /// Rotation from world to camera, (w, x, y, z), not necessarily of unit length.
    pub quaternion: [f64; 4],
    /// Translation from world to camera.
    pub translation: [f64; 3],
    /// Empty unless they are asked for.
    pub keypoints: Vec<ColmapKeypoint>,
}
