//! The common result of all capture formats: cameras, images and points.

use std::collections::HashMap;

use super::Point;

/// A sparse model, read and checked: all numbers are finite, every image's camera exists, and there
/// is at least one image and one point.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct SparseModel {
    /// Cameras by id.
    pub cameras: HashMap<u32, SparseCamera>,
    /// Images, sorted by name.
    pub images: Vec<SparseImage>,
    /// Points, in file order.
    pub points: Vec<Point>,
}

/// A pinhole camera of the model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SparseCamera {
    pub id: u32,
    pub width: u32,
    pub height: u32,
    /// `[fx, fy, cx, cy]` in pixels, pixel centres at + 0.5.
    pub intrinsics: [f64; 4],
}

/// A registered image of the model.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct SparseImage {
    pub id: u32,
    pub camera_id: u32,
    pub name: String,
    /// Rotation from world to camera, (w, x, y, z), not necessarily of unit length.
    pub quaternion: [f64; 4],
    /// Translation from world to camera.
    pub translation: [f64; 3],
}

impl SparseImage {
    /// World to camera, row-major 4x4, from the normalised quaternion and the translation.
    pub fn viewmat(&self) -> [[f64; 4]; 4] {
        // Divided by the largest component first, so that the squares neither underflow nor
        // overflow.
        let largest = self.quaternion.iter().fold(0.0, |m: f64, q| m.max(q.abs()));
        let scaled = self.quaternion.map(|q| q / largest);
        let length = scaled.iter().map(|q| q * q).sum::<f64>().sqrt();
        let [w, x, y, z] = scaled.map(|q| q / length);
        let [tx, ty, tz] = self.translation;
        [
            [
                1.0 - 2.0 * (y * y + z * z),
                2.0 * (x * y - w * z),
                2.0 * (x * z + w * y),
                tx,
            ],
            [
                2.0 * (x * y + w * z),
                1.0 - 2.0 * (x * x + z * z),
                2.0 * (y * z - w * x),
                ty,
            ],
            [
                2.0 * (x * z - w * y),
                2.0 * (y * z + w * x),
                1.0 - 2.0 * (x * x + y * y),
                tz,
            ],
            [0.0, 0.0, 0.0, 1.0],
        ]
    }
}
