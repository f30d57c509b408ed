//! The common result of all capture formats: cameras, images and points.

use std::collections::HashMap;
use std::path::PathBuf;

use splat_core::Lens;

use super::random_points::Room;
use super::{Observation, Point};

/// A sparse model, read and checked: all numbers are finite, every image's camera exists, and there
/// is at least one image.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct SparseModel {
    /// Cameras by id.
    pub cameras: HashMap<u32, SparseCamera>,
    /// Images, sorted by name.
    pub images: Vec<SparseImage>,
    /// Points, in file order; empty if the capture has none.
    pub points: Vec<Point>,
    /// Keypoints of the images; empty if they were not asked for, or the format has none.
    pub observations: Vec<Observation>,
    /// The folder of the photos, if the format names their paths.
    pub photos: Option<PathBuf>,
    /// The format's own split.
    pub split: Option<NamedSplit>,
    /// Colour on which transparent photos are composited; `None` if alpha is a mask.
    pub background: Option<[f32; 3]>,
    /// The cube of random points, if there are no others; by default it follows from the cameras.
    pub room: Option<Room>,
}

/// A split by names of images.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct NamedSplit {
    /// Where it is from, for messages.
    pub source: String,
    /// Training images; `None` for all that are not held out.
    pub train: Option<Vec<String>>,
    /// Held-out images.
    pub test: Vec<String>,
}

/// A camera of the model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SparseCamera {
    pub id: u32,
    pub intrinsics: Intrinsics,
    pub lens: Lens,
}

/// Focal lengths and principal point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Intrinsics {
    /// `[fx, fy, cx, cy]` in pixels of images of this width and height, pixel centres at + 0.5.
    Pixels { size: [u32; 2], values: [f64; 4] },
    /// Of photos of any size.
    OfPhoto {
        /// Focal lengths along x and y, of which at least one is known; the other is by default the
        /// same number of pixels.
        focal: [Option<Focal>; 2],
        /// Principal point in pixels; by default the middle of the photo.
        center: [Option<f64>; 2],
    },
}

/// A focal length along one side of a photo.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Focal {
    Pixels(f64),
    /// The field of view in radians.
    Angle(f64),
}

impl Focal {
    fn pixels(self, side: f64) -> f64 {
        match self {
            Self::Pixels(value) => value,
            Self::Angle(angle) => 0.5 * side / (0.5 * angle).tan(),
        }
    }
}

impl Intrinsics {
    /// Width and height of the images that the camera took, if they are known.
    pub fn size(&self) -> Option<[u32; 2]> {
        match self {
            Self::Pixels { size, .. } => Some(*size),
            Self::OfPhoto { .. } => None,
        }
    }

    /// These for photos of one size.
    pub fn of_size(self, size: [u32; 2]) -> Self {
        match self.fit(size) {
            Some(values) => Self::Pixels { size, values },
            None => self,
        }
    }

    /// Size of the photos and `[fx, fy, cx, cy]` in their pixels, if these do not depend on the
    /// photo.
    pub fn pixels(&self) -> Option<([u32; 2], [f64; 4])> {
        match *self {
            Self::Pixels { size, values } => Some((size, values)),
            Self::OfPhoto { .. } => None,
        }
    }

    /// `[fx, fy, cx, cy]` for a photo of `size`, or `None` if its aspect ratio differs from the
    /// camera's, or a number overflows.
    ///
    /// A rescale counts as uniform if one factor explains both sides to within a pixel (sizes are
    /// rounded). Each side is then scaled by its own ratio, so that the photo's edges stay the
    /// camera's edges.
    pub fn fit(&self, size: [u32; 2]) -> Option<[f64; 4]> {
        let [w, h] = size.map(f64::from);
        let values = match *self {
            Self::Pixels { size, values } => {
                let [fx, fy, cx, cy] = values;
                let [cam_w, cam_h] = size.map(f64::from);
                let least = ((w - 1.0) / cam_w).max((h - 1.0) / cam_h);
                let most = ((w + 1.0) / cam_w).min((h + 1.0) / cam_h);
                let (sx, sy) = (w / cam_w, h / cam_h);
                if !(least <= most) {
                    return None;
                }
                [fx * sx, fy * sy, cx * sx, cy * sy]
            }
            Self::OfPhoto { focal, center } => {
                let [x, y] = focal;
                let (x, y) = (x.map(|x| x.pixels(w)), y.map(|y| y.pixels(h)));
                let [cx, cy] = center;
                let (cx, cy) = (cx.unwrap_or(0.5 * w), cy.unwrap_or(0.5 * h));
                [x.or(y)?, y.or(x)?, cx, cy]
            }
        };
        values
            .iter()
            .all(|value| value.is_finite())
            .then_some(values)
    }
}

/// An image of the model.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct SparseImage {
    pub id: u32,
    pub camera_id: u32,
    /// Path relative to the folder of photos.
    pub name: String,
    /// World to camera, row-major 4x4, last row `0 0 0 1`.
    pub viewmat: [[f64; 4]; 4],
    /// The mask that the capture names.
    pub mask: Option<PathBuf>,
    /// The depth map that the capture names.
    pub depth: Option<PathBuf>,
}

/// World to camera, row-major 4x4, from a quaternion (w, x, y, z) of any length but zero, and a
/// translation.
pub(super) fn viewmat(quaternion: [f64; 4], [tx, ty, tz]: [f64; 3]) -> [[f64; 4]; 4] {
    // Divided by the largest component first, so that the squares neither underflow nor overflow.
    let largest = quaternion.iter().fold(0.0, |m: f64, q| m.max(q.abs()));
    let scaled = quaternion.map(|q| q / largest);
    let length = scaled.iter().map(|q| q * q).sum::<f64>().sqrt();
    let [w, x, y, z] = scaled.map(|q| q / length);
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
