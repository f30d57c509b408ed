//! Cameras to render from: those of a capture or a file, or on a circle.

use std::f64::consts::TAU;
use std::path::Path;

use glam::{DMat3, DMat4, DVec3};
use serde::Deserialize;
use splat_data::SplatData;
use splat_model::Camera;
use splat_model::ops::ImageSize;

use super::super::{Failure, text};
use splat_data::{CameraModel, Capture, Lens, View};

/// Largest side in pixels: a picture of this size takes about 3 GB while rendering.
const MOST_PIXELS: u32 = 16_384;
/// Picture size and field of view of the orbit's cameras.
const ORBIT_SIZE: ImageSize = ImageSize {
    width: 640,
    height: 480,
};
const ORBIT_FOCAL: f64 = 600.0;

/// Cameras of all views of a capture, by the photo's name.
pub(super) fn of_capture(capture: &Capture) -> Vec<(String, Camera)> {
    let named = |view: &View| (view.name.clone(), view.camera());
    capture.views.iter().map(named).collect()
}

/// One camera of a camera file.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileCamera {
    name: Option<String>,
    width: u32,
    height: u32,
    intrinsics: [f64; 4],
    viewmat: [[f64; 4]; 4],
    camera_model: Option<String>,
    #[serde(default)]
    distortion: Vec<f64>,
}

/// Cameras of a file, by their names or their index.
pub(super) fn of_file(path: &Path) -> Result<Vec<(String, Camera)>, Failure> {
    text::read(path, of_text)
}

/// Cameras in a file's text.
fn of_text(text: &str) -> Result<Vec<(String, Camera)>, String> {
    let read = || -> serde_json::Result<Vec<FileCamera>> {
        match serde_json::from_str(text)? {
            list @ serde_json::Value::Array(_) => serde_json::from_value(list),
            one => Ok(vec![serde_json::from_value(one)?]),
        }
    };
    let cameras = read().map_err(|error| {
        format!("neither a camera nor a list of cameras (see `splat render --help`): {error}")
    })?;
    if cameras.is_empty() {
        return Err("no camera in it".to_owned());
    }
    let named = |(index, camera): (usize, FileCamera)| -> Result<(String, Camera), String> {
        let name = camera.name.clone();
        let name = name.unwrap_or_else(|| format!("camera_{index:04}"));
        match camera.checked() {
            Ok(camera) => Ok((name, camera)),
            Err(reason) => Err(format!("camera {index} (`{name}`): {reason}")),
        }
    };
    cameras.into_iter().enumerate().map(named).collect()
}

impl FileCamera {
    /// The lens: a pinhole unless the file names another camera model.
    fn lens(&self) -> Result<Lens, String> {
        let name = self.camera_model.as_deref().unwrap_or("pinhole");
        let Some(model) = CameraModel::of_name(name) else {
            let known = CameraModel::ALL.map(CameraModel::name).join(", ");
            return Err(format!("camera_model `{name}` is none of {known}"));
        };
        let finite = self.distortion.iter().all(|k| k.is_finite());
        let lens = Lens::new(model, &self.distortion).filter(|_| finite);
        lens.ok_or_else(|| match model {
            CameraModel::Pinhole => {
                "distortion needs a camera_model: opencv or opencv_fisheye".to_owned()
            }
            _ => format!(
                "distortion of `{name}` must be {} finite numbers: {}",
                model.coefficients(),
                model.coefficient_names().join(", ")
            ),
        })
    }

    fn checked(self) -> Result<Camera, String> {
        let sides = [self.width, self.height];
        if !sides.iter().all(|side| (1..=MOST_PIXELS).contains(side)) {
            return Err("width and height must be 1 to 16384".to_owned());
        }
        let [fx, fy, ..] = self.intrinsics;
        if !(self.intrinsics.iter().all(|x| x.is_finite()) && fx > 0.0 && fy > 0.0) {
            return Err("intrinsics must be finite, fx and fy positive".to_owned());
        }
        let lens = self.lens()?;
        let viewmat = DMat4::from_cols_array_2d(&self.viewmat).transpose();
        let rotation = DMat3::from_mat4(viewmat);
        let error = rotation * rotation.transpose() - DMat3::IDENTITY;
        let is_rotation =
            error.to_cols_array().iter().all(|e| e.abs() <= 1e-4) && rotation.determinant() > 0.0;
        if !(is_rotation && viewmat.is_finite() && self.viewmat[3] == [0.0, 0.0, 0.0, 1.0]) {
            let what = "viewmat must be a rotation and a translation, its last row 0 0 0 1";
            return Err(what.to_owned());
        }
        Ok(Camera {
            viewmat,
            intrinsics: self.intrinsics,
            lens,
            size: ImageSize {
                width: self.width,
                height: self.height,
            },
        })
    }
}

/// `count` cameras on a horizontal circle about the middle of the scene, looking at it. Up is -y,
/// as for a camera held upright. The middle is the median of each axis; the circle keeps nine
/// tenths of the scene in view.
pub(super) fn orbit(scene: &SplatData, count: u32) -> Vec<(String, Camera)> {
    let origin = DVec3::from(scene.origin);
    let middle = DVec3::from_array(std::array::from_fn(|axis| {
        quantile(scene.means.iter().map(|mean| f64::from(mean[axis])), 0.5)
    }));
    let distance = |mean: &[f32; 3]| DVec3::from(mean.map(f64::from)).distance(middle);
    let reach = quantile(scene.means.iter().map(distance), 0.9);
    // One Gaussian, or all at one position.
    let size = scene.scene_scale().length();
    let reach = if reach > 0.0 { reach } else { size };
    // A sphere of that radius just fits the height of the picture.
    let half_height = f64::from(ORBIT_SIZE.height) / 2.0;
    let radius = reach * (ORBIT_FOCAL / half_height).hypot(1.0);
    (0..count)
        .map(|index| {
            let angle = TAU * f64::from(index) / f64::from(count);
            let forward = DVec3::new(-angle.sin(), 0.0, angle.cos());
            let down = DVec3::Y;
            let right = down.cross(forward);
            let rotation = DMat3::from_cols(right, down, forward).transpose();
            let center = origin + middle - radius * forward;
            let mut viewmat = DMat4::from_mat3(rotation);
            viewmat.w_axis = (-(rotation * center)).extend(1.0);
            let camera = Camera {
                viewmat,
                intrinsics: [
                    ORBIT_FOCAL,
                    ORBIT_FOCAL,
                    f64::from(ORBIT_SIZE.width) / 2.0,
                    half_height,
                ],
                lens: Lens::Pinhole,
                size: ORBIT_SIZE,
            };
            (format!("orbit_{index:04}"), camera)
        })
        .collect()
}

/// The value that `share` of the values do not exceed; 0 if there are none.
fn quantile(values: impl Iterator<Item = f64>, share: f64) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let last = values.len().saturating_sub(1);
    let at = (share * last as f64).round() as usize;
    values.get(at).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_orbit_looks_at_the_middle() {
        let mut scene = SplatData::default();
        for i in 0..101 {
            let x = i as f32 - 50.0;
            scene.means.push([x + 10.0, 0.1 * x, 5.0]);
        }
        for (_, camera) in orbit(&scene, 7) {
            let seen = camera.viewmat.transform_point3(DVec3::new(10.0, 0.0, 5.0));
            assert!(seen.truncate().length() < 1e-9 && seen.z > 45.0, "{seen}");
            let rotation = DMat3::from_mat4(camera.viewmat);
            assert!((rotation.determinant() - 1.0).abs() < 1e-12);
            // The world's -y is up in the picture.
            let above = camera.viewmat.transform_point3(DVec3::new(10.0, -1.0, 5.0));
            assert!(above.y < seen.y);
        }
    }

    #[test]
    fn camera_files_are_checked() {
        let folder = tempfile::TempDir::new().unwrap();
        let path = folder.path().join("camera.json");
        let good = r#"{"width": 64, "height": 48, "intrinsics": [50, 50, 32, 24],
            "viewmat": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]}"#;
        let read = |text: &str| {
            std::fs::write(&path, text).unwrap();
            of_file(&path)
        };
        let cameras = read(good).unwrap();
        assert_eq!(cameras[0].0, "camera_0000");
        assert_eq!(cameras[0].1.position(), DVec3::new(-1.0, -2.0, -3.0));
        assert_eq!(read(&format!("[{good}, {good}]")).unwrap().len(), 2);
        // Some editors start a text with this.
        assert_eq!(read(&format!("\u{FEFF}{good}")).unwrap().len(), 1);
        let bent = |camera: &str| good.replacen("\"width\"", &format!("{camera}, \"width\""), 1);
        let fisheye = r#""camera_model": "opencv_fisheye", "distortion": [0.1, 0, 0, 0]"#;
        let cameras = read(&bent(fisheye)).unwrap();
        assert_eq!(cameras[0].1.lens, Lens::OpenCvFisheye([0.1, 0.0, 0.0, 0.0]));
        for (camera, reason) in [
            (
                r#""camera_model": "fov""#,
                "`fov` is none of pinhole, opencv",
            ),
            (r#""distortion": [0.1]"#, "needs a camera_model"),
            (
                r#""camera_model": "opencv", "distortion": [1]"#,
                "must be 8 finite numbers: k1",
            ),
        ] {
            let message = read(&bent(camera)).unwrap_err().to_string();
            assert!(message.contains(reason), "{message}");
        }
        for (from, to) in [
            ("64", "0"),
            ("48", "99999"),
            ("50,", "-50,"),
            ("[[1,0,0,1]", "[[2,0,0,1]"),
            ("[[1,0,0,1]", "[[-1,0,0,1]"),
            ("[0,0,0,1]", "[0,0,1,1]"),
            ("width", "wide"),
        ] {
            let message = read(&good.replacen(from, to, 1)).unwrap_err().to_string();
            assert!(message.contains("camera.json"), "{message}");
        }
        assert!(read("[]").is_err());
    }
}
