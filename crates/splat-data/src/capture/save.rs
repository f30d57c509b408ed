//! Writes a capture to a folder in the form that [`Capture::load`] and COLMAP read: photos, a
//! binary model, and the split.

use std::io::{Cursor, Error, ErrorKind};
use std::path::Path;

use glam::{DMat3, DQuat};
use image::{ExtendedColorType, ImageFormat};

use super::{Capture, CaptureError, View};
use crate::write_atomically;

/// COLMAP's number of the camera model PINHOLE.
const PINHOLE: i32 = 1;

impl Capture {
    /// Writes the capture to the folder `root`: `images/`, `sparse/0/*.bin` with a PINHOLE camera
    /// per view, and `split.json`. Photos are written as PNG, whatever their names end in. The
    /// model is written last, so that an incomplete folder is not taken for a capture.
    ///
    /// # Errors
    ///
    /// [`CaptureError::Io`] if `root` already contains a model (the only remains of somebody's
    /// photos, perhaps), if a file cannot be written, or if the length of a view's `image` does not
    /// match its size.
    pub fn save(&self, root: &Path) -> Result<(), CaptureError> {
        let model = root.join("sparse");
        if model.exists() {
            let there = "there is a capture already; choose another folder";
            return Err(CaptureError::Io {
                path: model,
                source: Error::new(ErrorKind::AlreadyExists, there),
            });
        }
        let write = |path: &Path, bytes: &[u8]| {
            let path = root.join(path);
            write_atomically(&path, bytes).map_err(|source| CaptureError::Io { path, source })
        };
        for view in &self.views {
            let name = Path::new("images").join(&view.name);
            let png = png(view).map_err(|source| CaptureError::Io {
                path: root.join(&name),
                source,
            })?;
            write(&name, &png)?;
        }
        let names = |indices: &[usize]| -> Vec<&str> {
            let names = indices.iter().map(|index| &*self.views[*index].name);
            names.collect()
        };
        let split = serde_json::json!({
            "train": names(&self.split.train),
            "test": names(&self.split.test),
        });
        write("split.json".as_ref(), split.to_string().as_bytes())?;
        write("sparse/0/points3D.bin".as_ref(), &self.points_bin())?;
        write("sparse/0/images.bin".as_ref(), &self.images_bin())?;
        write("sparse/0/cameras.bin".as_ref(), &self.cameras_bin())
    }

    fn cameras_bin(&self) -> Vec<u8> {
        let mut out = count(self.views.len());
        for (id, view) in (1u32..).zip(&self.views) {
            out.extend(id.to_le_bytes());
            out.extend(PINHOLE.to_le_bytes());
            out.extend(u64::from(view.width).to_le_bytes());
            out.extend(u64::from(view.height).to_le_bytes());
            out.extend(view.intrinsics.iter().flat_map(|value| value.to_le_bytes()));
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

fn png(view: &View) -> std::io::Result<Vec<u8>> {
    let mut out = Cursor::new(vec![]);
    let pixels = 3 * view.width as usize * view.height as usize;
    if view.image.len() != pixels {
        let wrong = format!("{} bytes for {pixels} values", view.image.len());
        return Err(Error::other(wrong));
    }
    image::write_buffer_with_format(
        &mut out,
        &view.image,
        view.width,
        view.height,
        ExtendedColorType::Rgb8,
        ImageFormat::Png,
    )
    .map_err(Error::other)?;
    Ok(out.into_inner())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

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
        capture.save(to.path()).unwrap();

        let again = Capture::load(to.path(), &options).unwrap();
        assert_eq!(again.warnings, capture.warnings);
        assert_eq!(again.points, capture.points);
        assert_eq!(again.split, capture.split);
        assert_eq!(again.views.len(), capture.views.len());
        for (view, before) in again.views.iter().zip(&capture.views) {
            assert_eq!(view.name, before.name);
            assert_eq!([view.width, view.height], [before.width, before.height]);
            assert_eq!(view.intrinsics, before.intrinsics);
            assert_eq!(view.image, before.image);
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
}
