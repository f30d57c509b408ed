//! Captures and scene files as plain data, without tensors.
//!
//! [`Capture`] is a set of photos with their cameras and the points from structure from motion;
//! [`scene`] reads and writes trained splats ([`SplatData`]); [`SceneScale`] is the size of a
//! scene, from which every length follows.

mod camera;
pub mod capture;
mod replace;
pub mod scene;
mod scene_scale;
#[doc(hidden)]
pub mod text;

pub use camera::Camera;
pub use capture::{
    Capture, CaptureError, CaptureSettings, CaptureWarning, Point, Split, SplitRule, View,
};
pub use replace::{
    WriteError, probe_file, probe_files, probe_folder, write_atomically, write_durably,
};
pub use scene::{SceneFileError, SceneSettings, SplatData};
pub use scene_scale::SceneScale;
pub use splat_core::{CameraModel, ImageSize, Lens, LensDomain};
