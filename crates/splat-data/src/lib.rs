//! Captures and scene files as plain data, without tensors.
//!
//! [`Capture`] is a set of photos with their cameras, masks, and the points from structure from
//! motion, from COLMAP, nerfstudio, instant-ngp or Blender; [`scene`] reads and writes trained
//! splats ([`SplatData`]); [`SceneScale`] is the size of a scene, from which every length follows.
//!
//! ```
//! use splat_data::{Capture, CaptureSettings, SplitRule};
//!
//! # let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
//! let options = CaptureSettings::new()
//!     .with_downscale(16)
//!     .with_split(SplitRule::Every(10));
//! let capture = Capture::load(folder, &options)?;
//! for warning in &capture.warnings {
//!     eprintln!("warning: {warning}");
//! }
//! let view = &capture.views[0];
//! assert_eq!(view.image.len(), 3 * (view.width * view.height) as usize);
//! assert_eq!(capture.split.test.len(), 4);
//! let (pixel, depth) = view.project(capture.points[0].position).expect("in front");
//! println!("{}: {pixel:?} at {depth}", view.name);
//! # Ok::<(), splat_data::CaptureError>(())
//! ```

mod camera;
pub mod capture;
mod replace;
pub mod scene;
mod scene_scale;
#[doc(hidden)]
pub mod text;

pub use camera::Camera;
pub use capture::{
    Capture, CaptureError, CaptureSettings, CaptureWarning, Observation, PhotoOnDisk, Point, Split,
    SplitRule, View,
};
/// Matrices and vectors in double precision, of which cameras are made.
pub use glam;
pub use replace::{
    WriteError, probe_file, probe_files, probe_folder, write_atomically, write_durably,
};
pub use scene::{SceneFileError, SceneSettings, SplatData};
pub use scene_scale::SceneScale;
pub use splat_core::{BoundedLens, CameraModel, ImageSize, Lens, LensDomain};
