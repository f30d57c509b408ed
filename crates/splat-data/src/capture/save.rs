//! Writes a capture to a folder in the form that [`Capture::load`] and COLMAP read: photos, masks,
//! a binary model, and the split.

use std::io::{Cursor, Error, ErrorKind};
use std::path::Path;

use glam::{DMat3, DQuat};
use image::{ExtendedColorType, ImageFormat};

use super::colmap_models::number_and_parameters;
use super::{Capture, CaptureError, View};
use crate::write_atomically;

impl Capture {
    /// Writes the capture to the folder `root`: `images/`, `masks/NAME.png` for views with a mask,
    /// `sparse/0/*.bin` as [`Capture::save_model`] writes them, and `split.json`. Photos are
    /// written as PNG, whatever their names end in. The model is written last, so that an
    /// incomplete folder is not taken for a capture.
    ///
    /// [`Capture::background`] and [`View::depth`] have no place in a COLMAP capture, and are not
    /// written.
    ///
    /// # Errors
    ///
    /// [`CaptureError::Io`] if `root` already contains a model (the only remains of somebody's
    /// photos, perhaps), if a file cannot be written, or if the length of a view's `image` or
    /// `mask` does not match its size.
    pub fn save(&self, root: &Path) -> Result<(), CaptureError> {
        let model = root.join("sparse");
        if model.exists() {
            return Err(already_there(&model));
        }
        for view in &self.views {
            let view = &*view.loaded()?;
            let name = Path::new("images").join(&view.name);
            write(
                &root.join(&name),
                png(view, &view.image, ExtendedColorType::Rgb8),
            )?;
            if let Some(mask) = &view.mask {
                let path = root.join("masks").join(format!("{}.png", view.name));
                write(&path, png(view, mask, ExtendedColorType::L8))?;
            }
        }
        let names = |indices: &[usize]| -> Vec<&str> {
            let names = indices.iter().map(|index| &*self.views[*index].name);
            names.collect()
        };
        let split = serde_json::json!({
            "train": names(&self.split.train),
            "test": names(&self.split.test),
        });
        write(&root.join("split.json"), Ok(split.to_string().into_bytes()))?;
        self.save_model(&model.join("0"))
    }

    /// Writes the cameras, images and points as a COLMAP model to `folder`: `cameras.bin`,
    /// `images.bin` and `points3D.bin`, for example after the cameras were refined. Every view gets
    /// a camera of its own with its lens: PINHOLE, OPENCV, FULL_OPENCV if any of k3 to k6 is not
    /// zero, or OPENCV_FISHEYE. Keypoints and tracks are not kept.
    ///
    /// ```
    /// use splat_data::{Capture, CaptureSettings};
    ///
    /// # let root = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
    /// # let folder = tempfile::tempdir().expect("a temporary folder");
    /// # let folder = folder.path();
    /// let mut capture = Capture::load(root, &CaptureSettings::new().with_downscale(16))?;
    /// capture.views[0].viewmat[0][3] += 0.01;
    /// capture.save_model(&folder.join("sparse/0"))?;
    /// # Ok::<(), splat_data::CaptureError>(())
    /// ```
    ///
    /// # Errors
    ///
    /// [`CaptureError::Io`] if `folder` already holds a model, or a file cannot be written.
    pub fn save_model(&self, folder: &Path) -> Result<(), CaptureError> {
        for file in ["cameras.bin", "cameras.txt"] {
            let path = folder.join(file);
            if path.exists() {
                return Err(already_there(&path));
            }
        }
        write(&folder.join("points3D.bin"), Ok(self.points_bin()))?;
        write(&folder.join("images.bin"), Ok(self.images_bin()))?;
        write(&folder.join("cameras.bin"), Ok(self.cameras_bin()))
    }

    fn cameras_bin(&self) -> Vec<u8> {
        let mut out = count(self.views.len());
        for (id, view) in (1u32..).zip(&self.views) {
            let (model, parameters) = number_and_parameters(view.intrinsics, &view.lens);
            out.extend(id.to_le_bytes());
            out.extend(model.to_le_bytes());
            out.extend(u64::from(view.width).to_le_bytes());
            out.extend(u64::from(view.height).to_le_bytes());
            out.extend(parameters.iter().flat_map(|value| value.to_le_bytes()));
        }
        out
    }

    fn images_bin(&self) -> Vec<u8> {
        let mut out = count(self.views.len());
        for (id, view) in (1u32..).zip(&self.views) {
            let [[a, b, c, x], [d, e, f, y], [g, h, i, z], _] = view.viewmat;
            // Column-major.
            let rotation = DMat3::from_cols_array(&[a, d, g, b, e, h, c, f, i]);
            let DQuat {
                x: qx,
                y: qy,
                z: qz,
                w: qw,
            } = DQuat::from_mat3(&rotation);
            out.extend(id.to_le_bytes());
            let pose = [qw, qx, qy, qz, x, y, z];
            out.extend(pose.iter().flat_map(|value| value.to_le_bytes()));
            out.extend(id.to_le_bytes());
            out.extend(view.name.as_bytes());
            out.push(0);
            // No keypoints.
            out.extend(count(0));
        }
        out
    }

    fn points_bin(&self) -> Vec<u8> {
        let mut out = count(self.points.len());
        for (id, point) in (1u64..).zip(&self.points) {
            out.extend(id.to_le_bytes());
            out.extend(point.position.iter().flat_map(|value| value.to_le_bytes()));
            out.extend(point.color);
            // The error is unknown, and no photo shows the point.
            out.extend((-1.0f64).to_le_bytes());
            out.extend(count(0));
        }
        out
    }
}

/// A count as COLMAP writes it at the start of a list.
fn count(length: usize) -> Vec<u8> {
    (length as u64).to_le_bytes().to_vec()
}

fn already_there(path: &Path) -> CaptureError {
    let there = "there is a capture already; choose another folder";
    CaptureError::Io {
        path: path.to_path_buf(),
        source: Error::new(ErrorKind::AlreadyExists, there),
    }
}

fn write(path: &Path, bytes: std::io::Result<Vec<u8>>) -> Result<(), CaptureError> {
    bytes
        .and_then(|bytes| write_atomically(path, &bytes))
        .map_err(|source| CaptureError::Io {
            path: path.to_path_buf(),
            source,
        })
}

/// A picture of the view's size as PNG.
fn png(view: &View, pixels: &[u8], color: ExtendedColorType) -> std::io::Result<Vec<u8>> {
    let mut out = Cursor::new(vec![]);
    let expected = view.pixel_count() * usize::from(color.channel_count());
    if pixels.len() != expected {
        let wrong = format!("{} bytes for {expected} values", pixels.len());
        return Err(Error::other(wrong));
    }
    let (width, height) = (view.width, view.height);
    image::write_buffer_with_format(&mut out, pixels, width, height, color, ImageFormat::Png)
        .map_err(Error::other)?;
    Ok(out.into_inner())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use splat_core::Lens;

    use super::*;
    use crate::CaptureSettings;
    use crate::capture::test_capture::TestCapture;

    /// Nine photos from two cameras survive a round trip.
    #[test]
    fn a_capture_is_read_as_it_was_written() {
        let [from, to] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let model = TestCapture::new();
        model.write_photos(from.path());
        model.write_binary(&from.path().join("sparse/0"));
        let options = CaptureSettings::default();
        let mut capture = Capture::load(from.path(), &options).unwrap();
        capture.split.train = vec![0, 3, 4];
        capture.split.test = vec![1, 2, 5, 6, 7, 8];
        let opencv = [-0.1, 0.02, 1e-3, -2e-3, 0.0, 0.0, 0.0, 0.0];
        let full = [-0.1, 0.02, 1e-3, -2e-3, 0.0, 0.0, 3e-3, 0.0];
        capture.views[1].lens = Lens::OpenCv(opencv);
        capture.views[2].lens = Lens::OpenCv(full);
        capture.views[3].lens = Lens::OpenCvFisheye([0.01, 0.0, -0.02, 0.003]);
        let pixels = (0..capture.views[4].pixel_count()).map(|i| (i * 7) as u8);
        capture.views[4].mask = Some(Arc::new(pixels.collect()));
        capture.save(to.path()).unwrap();

        let again = Capture::load(to.path(), &options).unwrap();
        assert_eq!(again.points, capture.points);
        assert_eq!(again.split, capture.split);
        assert_eq!(again.views.len(), capture.views.len());
        for (view, before) in again.views.iter().zip(&capture.views) {
            assert_eq!(view.name, before.name);
            assert_eq!([view.width, view.height], [before.width, before.height]);
            assert_eq!(view.intrinsics, before.intrinsics);
            assert_eq!(view.lens, before.lens);
            assert_eq!(view.image, before.image);
            assert_eq!(view.mask, before.mask);
            let entries = view.viewmat.as_flattened().iter();
            for (entry, before) in entries.zip(before.viewmat.as_flattened()) {
                assert!((entry - before).abs() < 1e-12, "{entry} for {before}");
            }
        }

        // Nothing is overwritten.
        let error = capture.save(from.path()).unwrap_err().to_string();
        assert!(error.contains("sparse: there is a capture"), "{error}");
        assert!(!from.path().join("split.json").exists());

        let to = tempfile::tempdir().unwrap();
        Arc::make_mut(&mut capture.views[2].image).pop();
        let error = capture.save(to.path()).unwrap_err().to_string();
        assert!(error.contains(&capture.views[2].name), "{error}");
        assert!(!to.path().join("sparse").exists());
    }

    #[test]
    fn a_model_alone_is_written_once() {
        let [from, to] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let model = TestCapture::new();
        model.write_photos(from.path());
        model.write_binary(&from.path().join("sparse/0"));
        let mut capture = Capture::load(from.path(), &CaptureSettings::new()).unwrap();
        capture.views[5].viewmat[1][3] += 0.25;
        let folder = to.path().join("sparse/0");
        capture.save_model(&folder).unwrap();
        let error = capture.save_model(&folder).unwrap_err().to_string();
        assert!(error.contains("cameras.bin: there is"), "{error}");
        model.write_photos(to.path());
        let again = Capture::load(to.path(), &CaptureSettings::new()).unwrap();
        let moved = again.views[5].viewmat[1][3];
        assert!((moved - capture.views[5].viewmat[1][3]).abs() < 1e-12);
    }
}
