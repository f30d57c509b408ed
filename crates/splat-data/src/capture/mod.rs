//! Captures: photos with their cameras and the points from structure from motion.
//!
//! [`Capture::load`] reads a folder in COLMAP's layout, or with `transforms.json` (nerfstudio,
//! instant-ngp, Blender), decodes every photo once in parallel, and returns plain data, without
//! tensors or printed output. Problems that can be tolerated are returned as [`Capture::warnings`];
//! others are a [`CaptureError`] that names the file, the record and the remedy.
//!
//! Which files are read, and what their fields mean, is in `docs/CAPTURES.md`.
//!
//! Conventions (project-wide): right-handed world; camera axes +x right, +y down, +z forward; the
//! view matrix maps world to camera; the centre of pixel (i, j) is at (i + 0.5, j + 0.5).

mod check;
mod colmap;
mod colmap_binary;
mod colmap_checks;
mod colmap_folder;
mod colmap_models;
mod colmap_records;
mod colmap_text;
mod downscale;
mod error;
mod format;
mod formats;
mod images;
#[doc(hidden)]
pub mod in_memory;
mod jpeg;
mod lens_checks;
mod masks;
mod observations;
mod on_disk;
mod other_cameras;
mod photo_file;
mod photo_loader;
mod photo_memory;
mod points_file;
mod random_points;
mod save;
mod sparse_model;
mod split;
mod transforms;
mod undistort;
mod warning;

use derive_setters::Setters;
use std::borrow::Cow;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::{DMat4, DVec4};
use splat_core::{ImageSize, Lens};

use crate::{Camera, SceneScale};
use random_points::Room;

pub use error::CaptureError;
pub use observations::Observation;
pub use on_disk::PhotoOnDisk;
pub use split::{Split, SplitRule};
pub use warning::CaptureWarning;

/// A photo capture in memory: all photos with their cameras, the sparse points, and the held-out
/// split.
#[derive(Debug, Clone)]
pub struct Capture {
    /// Name of the capture's folder.
    pub name: String,
    /// The folder that was read.
    pub root: PathBuf,
    /// The folder of the photos.
    pub photos: PathBuf,
    /// All views, sorted by [`View::name`]. Never empty.
    pub views: Vec<View>,
    /// Points of structure from motion, in file order; random ones, with a warning, if the capture
    /// has none. Never empty.
    pub points: Vec<Point>,
    /// Keypoints at which photos show the points, sorted by view: those of a COLMAP model, if
    /// [`CaptureSettings::observations`] asks for them.
    pub observations: Vec<Observation>,
    /// Colour behind the scene, from 0 to 1, if the capture has one: white for a Blender capture,
    /// whose transparent photos were composited on it. `None` for photos of the real world.
    pub background: Option<[f32; 3]>,
    /// Indices into [`Capture::views`]: for training, and held out.
    pub split: Split,
    /// Problems that did not prevent reading.
    pub warnings: Vec<CaptureWarning>,
}

/// Is told the number of photos that are done, and of all.
type Progress<'a> = &'a (dyn Fn(usize, usize) + Sync);

/// One photo and the camera that took it.
#[derive(Debug, Clone)]
pub struct View {
    /// Name of the photo in the capture, relative to the folder of the photos, from which it never
    /// leads out.
    pub name: String,
    /// Width of `image` in pixels.
    pub width: u32,
    /// Height of `image` in pixels.
    pub height: u32,
    /// `[fx, fy, cx, cy]` in pixels of `image`; the centre of pixel (i, j) is at (i + 0.5, j +
    /// 0.5).
    pub intrinsics: [f64; 4],
    /// World to camera, row-major 4x4, last row `0 0 0 1`.
    pub viewmat: [[f64; 4]; 4],
    /// Camera model and distortion.
    pub lens: Lens,
    /// 8-bit RGB, row by row from the top: `3 * width * height` bytes. Shared, so that a view is
    /// cheap to clone. Empty if the photo is [`on_disk`](Self::on_disk): see [`View::loaded`].
    pub image: Arc<Vec<u8>>,
    /// Which pixels count, `width * height` bytes from 0 (ignored) to 255; `None` if all do, or if
    /// the photo is [`on_disk`](Self::on_disk).
    pub mask: Option<Arc<Vec<u8>>>,
    /// The depth map that the capture names, if any. It exists, and is not read here.
    pub depth: Option<PathBuf>,
    /// The photo, if it is not in memory ([`CaptureSettings::memory`]).
    pub on_disk: Option<PhotoOnDisk>,
}

/// A point of structure from motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// World position.
    pub position: [f64; 3],
    /// 8-bit RGB.
    pub color: [u8; 3],
}

/// Settings for reading a capture.
#[derive(Debug, Clone, PartialEq, Eq, Setters)]
#[setters(prefix = "with_", strip_option)]
pub struct CaptureSettings {
    /// Factor by which every photo is area-averaged, at least 1. Default 1.
    pub downscale: u32,
    /// Folder of the photos, relative to the capture or absolute. Default: `images`, or the
    /// capture's folder if that does not exist.
    pub images: Option<PathBuf>,
    /// A folder with a COLMAP model whose cameras and poses the views have in place of the
    /// capture's, by the names of their images, such as the refined ones of a run. Default: none.
    pub cameras: Option<PathBuf>,
    /// Which views are held out of training. Default: those that the capture says.
    pub split: SplitRule,
    /// Most bytes of memory for the pixels of all photos. If they need more, every photo stays on
    /// the disk, with a warning, and is decoded by [`View::loaded`]. Default: half of the memory
    /// that is available, and no bound on systems other than Linux, which do not report it.
    pub memory: Option<u64>,
    /// Read [`Capture::observations`] too, 32 bytes for each. Default false.
    pub observations: bool,
}

impl CaptureSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }
}

impl Default for CaptureSettings {
    fn default() -> Self {
        Self {
            downscale: 1,
            images: None,
            cameras: None,
            split: SplitRule::default(),
            memory: None,
            observations: false,
        }
    }
}

impl Capture {
    /// Reads the capture in the folder `root`, or the `transforms.json` that `root` is.
    ///
    /// Read is the first of these that the folder has; a warning names others:
    ///
    /// 1. a COLMAP model in a numbered folder of `sparse`, of which the one with the most images
    ///    counts, or in `sparse` or `root`, binary before text;
    /// 2. `transforms_train.json`, with `transforms_test.json`, or else `transforms_val.json`, held
    ///    out;
    /// 3. `transforms.json`.
    ///
    /// If a photo's size is a uniform rescale of its camera's, the intrinsics are scaled to the
    /// photo, with a warning. Photos are JPEG, PNG, WebP or TIFF, and are kept as 8-bit RGB. A
    /// photo with a missing part is refused. Alpha and masks become [`View::mask`]; Blender's
    /// pictures are composited on white instead ([`Capture::background`]). A capture without points
    /// gets random ones, with a warning.
    ///
    /// Reading a COLMAP model takes less than 32 times the memory of its files, a `transforms.json`
    /// 128 times, and a JPEG file 64 times, while it is read. The pixels of the photos take three
    /// bytes each in addition, or four with masks, and up to twelve while a photo is decoded. If
    /// that is more than [`CaptureSettings::memory`], photos stay on the disk, and are only checked
    /// when they are decoded.
    ///
    /// ```
    /// use splat_data::{Capture, CaptureSettings};
    ///
    /// # let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
    /// let capture = Capture::load(folder, &CaptureSettings::new().with_downscale(16))?;
    /// println!("{} photos, {} points", capture.views.len(), capture.points.len());
    /// # Ok::<(), splat_data::CaptureError>(())
    /// ```
    ///
    /// # Errors
    ///
    /// [`CaptureError`] if the capture is unusable. A capture of a single photo can be read;
    /// [`Capture::check_trainable`] decides whether it can be trained.
    pub fn load(root: impl AsRef<Path>, options: &CaptureSettings) -> Result<Self, CaptureError> {
        Self::load_with_progress(root, options, &|_, _| {})
    }

    /// [`Capture::load`], which calls `progress` with the number of photos that are decoded and
    /// that of all photos, after each of them and from several threads.
    ///
    /// ```
    /// use std::sync::atomic::{AtomicUsize, Ordering};
    ///
    /// use splat_data::{Capture, CaptureSettings};
    ///
    /// # let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
    /// let calls = AtomicUsize::new(0);
    /// let progress = |done: usize, total: usize| {
    ///     assert!(done <= total);
    ///     calls.fetch_add(1, Ordering::Relaxed);
    /// };
    /// let options = CaptureSettings::new().with_downscale(16);
    /// let capture = Capture::load_with_progress(folder, &options, &progress)?;
    /// assert_eq!(calls.into_inner(), capture.views.len());
    /// # Ok::<(), splat_data::CaptureError>(())
    /// ```
    ///
    /// # Errors
    ///
    /// Those of [`Capture::load`].
    pub fn load_with_progress(
        root: impl AsRef<Path>,
        options: &CaptureSettings,
        progress: &(dyn Fn(usize, usize) + Sync),
    ) -> Result<Self, CaptureError> {
        if options.downscale == 0 {
            return Err(CaptureError::ZeroDownscale);
        }
        let (mut model, mut warnings) = formats::read(root.as_ref(), options)?;
        let root = match root.as_ref() {
            file if file.is_file() => match file.parent() {
                Some(folder) if !folder.as_os_str().is_empty() => folder,
                _ => Path::new("."),
            },
            folder => folder,
        };
        let photos = images::folder(root, &model, options)?;
        let mut views = images::load(root, &photos, &model, options, progress, &mut warnings)?;
        if let Some(folder) = &options.cameras {
            other_cameras::take(folder, options.downscale, &mut views, &mut warnings)?;
        }
        warnings.extend(lens_checks::check(&views));
        if model.points.is_empty() {
            let cameras: Vec<Camera> = views.iter().map(View::camera).collect();
            let room = model.room.unwrap_or_else(|| Room::of_cameras(&cameras));
            model.points = random_points::draw(room, random_points::COUNT);
            warnings.push(room.warning());
        }
        let names: Vec<&str> = views.iter().map(|view| view.name.as_str()).collect();
        let split = Split::by_rule(
            &options.split,
            root,
            &names,
            model.split.as_ref(),
            &mut warnings,
        )?;
        Ok(Self {
            name: folder_name(root),
            root: root.to_path_buf(),
            photos,
            split,
            points: model.points,
            observations: model.observations,
            background: model.background,
            views,
            warnings,
        })
    }

    /// Files of the photos, in the order of the views.
    pub fn photo_files(&self) -> Vec<PathBuf> {
        let file = |view: &View| self.photos.join(&view.name);
        self.views.iter().map(file).collect()
    }

    /// Size of the scene, of all cameras and points ([`SceneScale::of_capture`]).
    pub fn scene_scale(&self) -> SceneScale {
        let cameras: Vec<Camera> = self.views.iter().map(View::camera).collect();
        let points: Vec<[f64; 3]> = self.points.iter().map(|point| point.position).collect();
        SceneScale::of_capture(&cameras, &points)
    }

    /// Views for training, sorted by name.
    pub fn train_views(&self) -> impl ExactSizeIterator<Item = &View> {
        self.split.train.iter().map(|&index| &self.views[index])
    }

    /// Held-out views, sorted by name.
    pub fn test_views(&self) -> impl ExactSizeIterator<Item = &View> {
        self.split.test.iter().map(|&index| &self.views[index])
    }

    /// Number of photos of each size, `(width, height, count)`, most frequent first.
    pub fn image_sizes(&self) -> Vec<(u32, u32, usize)> {
        let mut counts = HashMap::new();
        for view in &self.views {
            *counts.entry((view.width, view.height)).or_insert(0) += 1;
        }
        let mut sizes: Vec<_> = counts
            .into_iter()
            .map(|((width, height), count)| (width, height, count))
            .collect();
        sizes.sort_by_key(|&(width, height, count)| (std::cmp::Reverse(count), width, height));
        sizes
    }
}

impl View {
    /// Number of pixels.
    pub(crate) fn pixel_count(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Camera of the view.
    pub fn camera(&self) -> Camera {
        let [r0, r1, r2, r3] = self.viewmat.map(DVec4::from_array);
        Camera {
            viewmat: DMat4::from_cols(r0, r1, r2, r3).transpose(),
            intrinsics: self.intrinsics,
            lens: self.lens,
            size: ImageSize {
                width: self.width,
                height: self.height,
            },
        }
    }

    /// The view at the pose of another camera.
    #[must_use]
    pub fn with_pose(&self, camera: &Camera) -> Self {
        let row = |i| camera.viewmat.row(i).to_array();
        Self {
            viewmat: [row(0), row(1), row(2), row(3)],
            ..self.clone()
        }
    }

    /// The view with the camera's pose, intrinsics and lens.
    #[must_use]
    pub fn with_camera(&self, camera: &Camera) -> Self {
        Self {
            intrinsics: camera.intrinsics,
            lens: camera.lens,
            ..self.with_pose(camera)
        }
    }

    /// The view with its photo area-averaged by `factor`, as in [`CaptureSettings::downscale`], or
    /// by the largest smaller power of two that leaves both sides at least as long as SSIM's
    /// window.
    pub fn downscaled(&self, factor: u32) -> Self {
        let mut factor = factor;
        let shorter = self.width.min(self.height);
        while factor > 1 && shorter / factor < images::MIN_SIDE {
            factor = if factor.is_power_of_two() {
                factor / 2
            } else {
                factor.next_power_of_two() / 2
            };
        }
        if factor <= 1 {
            return self.clone();
        }
        let smaller = |image, mask| Self {
            name: self.name.clone(),
            width: self.width / factor,
            height: self.height / factor,
            intrinsics: downscale::intrinsics(self.intrinsics, factor),
            viewmat: self.viewmat,
            lens: self.lens,
            image,
            mask,
            depth: self.depth.clone(),
            on_disk: self.on_disk.as_ref().map(|photo| photo.downscaled(factor)),
        };
        if self.on_disk.is_some() {
            return smaller(Arc::default(), None);
        }
        let whole = downscale::Picture {
            pixels: &self.image,
            mask: self.mask.as_ref().map(|mask| mask.as_slice()),
            width: self.width,
            height: self.height,
        };
        let (image, mask) = downscale::area_average(&whole, factor);
        smaller(Arc::new(image), mask.map(Arc::new))
    }

    /// The view with its pixels in memory: the view itself, or with its photo and mask decoded from
    /// the disk. Camera and pose are those of this view.
    ///
    /// ```
    /// use splat_data::{Capture, CaptureSettings};
    ///
    /// # let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
    /// // Bytes for all photos, which is not enough.
    /// let options = CaptureSettings::new().with_downscale(16).with_memory(1_000);
    /// let capture = Capture::load(folder, &options)?;
    /// let view = &capture.views[0];
    /// assert!(view.on_disk.is_some() && view.image.is_empty());
    /// let loaded = view.loaded()?;
    /// assert_eq!(loaded.image.len(), 3 * (view.width * view.height) as usize);
    /// # Ok::<(), splat_data::CaptureError>(())
    /// ```
    ///
    /// # Errors
    ///
    /// [`CaptureError`] if the photo can no longer be read, or has another size than before.
    pub fn loaded(&self) -> Result<Cow<'_, Self>, CaptureError> {
        Ok(match &self.on_disk {
            None => Cow::Borrowed(self),
            Some(photo) => Cow::Owned(photo.load(self)?),
        })
    }

    /// Position of a world point in the photo, `(x, y)` in pixels, and its
    /// [`depth`](Lens::depth). `None` if the point is behind the camera, or where the lens is not
    /// defined.
    pub fn project(&self, point: [f64; 3]) -> Option<([f64; 2], f64)> {
        self.projection()(point)
    }

    /// [`project`](Self::project) for many points.
    pub fn projection(&self) -> impl Fn([f64; 3]) -> Option<([f64; 2], f64)> + '_ {
        let bounded = self.lens.bounded();
        move |point| {
            let p = std::array::from_fn(|row| {
                let r = &self.viewmat[row];
                r[0] * point[0] + r[1] * point[1] + r[2] * point[2] + r[3]
            });
            let [fx, fy, cx, cy] = self.intrinsics;
            let [a, b] = bounded.distort(p)?;
            Some(([fx * a + cx, fy * b + cy], self.lens.depth(p)))
        }
    }
}

/// Last component of the folder's path, also for `.` and `..`.
fn folder_name(root: &Path) -> String {
    let name = |path: &Path| Some(path.file_name()?.to_string_lossy().into_owned());
    name(root)
        .or_else(|| name(&root.canonicalize().ok()?))
        .unwrap_or_else(|| "capture".to_owned())
}

#[cfg(test)]
mod mask_tests;
#[cfg(test)]
mod on_disk_tests;
#[cfg(test)]
mod photo_tests;
#[cfg(test)]
mod split_tests;
#[cfg(test)]
mod test_capture;
#[cfg(test)]
mod tests;
