//! Keypoints of the photos that are observations of the capture's points.

/// A point of the capture as a photo shows it: a keypoint that structure from motion matched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// Index into [`Capture::views`](super::Capture::views).
    pub view: u32,
    /// Index into [`Capture::points`](super::Capture::points).
    pub point: u32,
    /// Position on the image plane under the capture's own intrinsics, lens included:
    /// `(x - cx) / fx` and `(y - cy) / fy` of the pixel, of a photo of any size.
    pub position: [f64; 2],
}
