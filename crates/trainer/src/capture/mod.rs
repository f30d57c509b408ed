//! Captures: photos with their cameras and the points that structure from motion found.
//!
//! [`Capture::load`] reads a folder in COLMAP's layout, decodes every photo once and in parallel, and returns plain
//! data: nothing here knows a tensor or prints a line. What is odd but usable comes back as
//! [`Capture::warnings`]; what is not is a [`CaptureError`] that names the file, the record and what to do.
//!
//! Conventions (those of the whole project): right-handed world; camera axes +x right, +y down, +z forward; the view
//! matrix maps world to camera; the centre of pixel (i, j) lies at (i + 0.5, j + 0.5).

mod error;
mod split;

use std::path::PathBuf;
use std::sync::Arc;

pub use error::{CaptureError, CaptureWarning};
pub use split::Split;

/// A photo capture, whole in memory: every photo with its camera, the sparse points, and which views are held out.
#[derive(Debug, Clone)]
pub struct Capture {
    /// Name of the capture's folder.
    pub name: String,
    /// The folder that was read.
    pub root: PathBuf,
    /// All views, sorted by [`View::name`].
    pub views: Vec<View>,
    /// Points of structure from motion, in file order. Never empty.
    pub points: Vec<Point>,
    /// Indices into [`Capture::views`]: to train on, and held out.
    pub split: Split,
    /// What is odd about the capture but did not prevent reading it.
    pub warnings: Vec<CaptureWarning>,
}

/// One photo and the pinhole camera that took it.
#[derive(Debug, Clone)]
pub struct View {
    /// Name of the photo as the capture gives it, relative to `images/`.
    pub name: String,
    /// Width of `image` in pixels.
    pub width: u32,
    /// Height of `image` in pixels.
    pub height: u32,
    /// `[fx, fy, cx, cy]` in pixels of `image`; the centre of pixel (i, j) is at (i + 0.5, j + 0.5).
    pub intrinsics: [f64; 4],
    /// World to camera, row-major 4x4, last row `0 0 0 1`.
    pub viewmat: [[f64; 4]; 4],
    /// 8-bit RGB, row by row from the top: `3 * width * height` bytes. Shared, so that a view is cheap to clone.
    pub image: Arc<Vec<u8>>,
}

/// A point of structure from motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// World position.
    pub position: [f64; 3],
    /// 8-bit RGB.
    pub color: [u8; 3],
}

/// How to read a capture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CaptureOptions {
    /// Area-average every photo by this factor (1: as it is). Default 1.
    pub downscale: u32,
}

impl Default for CaptureOptions {
    fn default() -> Self {
        Self { downscale: 1 }
    }
}
