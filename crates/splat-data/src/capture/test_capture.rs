//! A small synthetic capture for tests, written in COLMAP's binary or text encoding by code
//! independent of the readers.

use std::fmt::Write as _;
use std::path::Path;

use tempfile::TempDir;

use super::{Capture, CaptureError, CaptureSettings, Point};

/// (id, quaternion, translation, camera id, name).
type Image = (u32, [f64; 4], [f64; 3], u32, String);

/// The contents to write. [`TestCapture::new`] gives a valid capture, which tests then modify.
pub(super) struct TestCapture {
    /// (id, model number, width, height, parameters).
    pub cameras: Vec<(u32, i32, u64, u64, Vec<f64>)>,
    pub images: Vec<Image>,
    /// (id, point).
    pub points: Vec<(u64, Point)>,
}

/// Id of the fourth point, which keypoints refer to.
const SEEN: i64 = i64::MAX - 3;

/// Size of the two cameras.
pub(super) const SIZES: [[u32; 2]; 2] = [[32, 24], [24, 30]];

/// A valid binary capture in its own folder: nine views, from `view r.png` to `view z.png`.
pub(super) fn good() -> (TempDir, TestCapture) {
    let root = TempDir::new().unwrap();
    let capture = TestCapture::new();
    capture.write_photos(root.path());
    capture.write_binary(&root.path().join("sparse/0"));
    (root, capture)
}

pub(super) fn load(root: &Path) -> Result<Capture, CaptureError> {
    Capture::load(root, &CaptureSettings::default())
}

impl TestCapture {
    /// Nine images of two cameras (one of each supported model), with ids and names out of order.
    pub fn new() -> Self {
        let name = |i: u32| format!("view {}.png", char::from(b'z' - i as u8));
        Self {
            cameras: vec![
                (7, 1, 32, 24, vec![40.5, 41.25, 15.75, 12.5]),
                (2, 0, 24, 30, vec![33.0, 12.0, 15.0]),
            ],
            images: (0..9)
                .map(|i| {
                    let angle = f64::from(i) * 0.3;
                    // Twice unit length, as readers normalise.
                    let quaternion = [2.0 * angle.cos(), 0.0, 2.0 * angle.sin(), 0.0];
                    let camera = if i % 3 == 0 { 2 } else { 7 };
                    (
                        100 - i,
                        quaternion,
                        [0.1, -0.2, 4.0 + angle],
                        camera,
                        name(i),
                    )
                })
                .collect(),
            points: (0..5)
                .map(|i| {
                    let x = i as f64;
                    let position = [x / 3.0, -x * 1e-7, 1e6 - x];
                    let color = [i as u8, 255, 10 * i as u8];
                    (u64::MAX / 2 - i, Point { position, color })
                })
                .collect(),
        }
    }

    /// Writes photos of the right sizes under `root/images`.
    pub fn write_photos(&self, root: &Path) {
        std::fs::create_dir_all(root.join("images")).unwrap();
        for (id, _, _, camera, name) in &self.images {
            let [w, h] = SIZES[if *camera == 7 { 0 } else { 1 }];
            let pixel = |x, y| image::Rgb([x as u8, y as u8, *id as u8]);
            let photo = image::RgbImage::from_fn(w, h, pixel);
            photo.save(root.join("images").join(name)).unwrap();
        }
    }

    /// Writes the binary model to `folder`. Every second image has three keypoints: one without a
    /// point, one of the fourth point, and one of a point that is not there.
    pub fn write_binary(&self, folder: &Path) {
        std::fs::create_dir_all(folder).unwrap();
        std::fs::write(folder.join("cameras.bin"), self.cameras_bin()).unwrap();
        std::fs::write(folder.join("images.bin"), self.images_bin()).unwrap();
        std::fs::write(folder.join("points3D.bin"), self.points_bin()).unwrap();
    }

    pub fn cameras_bin(&self) -> Vec<u8> {
        let mut out = (self.cameras.len() as u64).to_le_bytes().to_vec();
        for (id, model, width, height, parameters) in &self.cameras {
            out.extend(id.to_le_bytes());
            out.extend(model.to_le_bytes());
            out.extend(width.to_le_bytes());
            out.extend(height.to_le_bytes());
            out.extend(parameters.iter().flat_map(|p| p.to_le_bytes()));
        }
        out
    }

    pub fn images_bin(&self) -> Vec<u8> {
        let mut out = (self.images.len() as u64).to_le_bytes().to_vec();
        for (index, (id, quaternion, translation, camera, name)) in self.images.iter().enumerate() {
            out.extend(id.to_le_bytes());
            out.extend(quaternion.iter().flat_map(|q| q.to_le_bytes()));
            out.extend(translation.iter().flat_map(|t| t.to_le_bytes()));
            out.extend(camera.to_le_bytes());
            out.extend(name.as_bytes());
            out.push(0);
            let keypoints: &[(f64, f64, i64)] = if index % 2 == 0 {
                &[(1.5, 2.5, -1), (3.0, 4.0, SEEN), (5.0, 4.0, 12)]
            } else {
                &[]
            };
            out.extend((keypoints.len() as u64).to_le_bytes());
            for (x, y, point) in keypoints {
                out.extend(x.to_le_bytes());
                out.extend(y.to_le_bytes());
                out.extend(point.to_le_bytes());
            }
        }
        out
    }

    pub fn points_bin(&self) -> Vec<u8> {
        let mut out = (self.points.len() as u64).to_le_bytes().to_vec();
        for (index, (id, point)) in self.points.iter().enumerate() {
            out.extend(id.to_le_bytes());
            out.extend(point.position.iter().flat_map(|x| x.to_le_bytes()));
            out.extend(point.color);
            out.extend(0.5f64.to_le_bytes());
            out.extend((index as u64).to_le_bytes());
            for _ in 0..index {
                out.extend(100u32.to_le_bytes());
                out.extend(0u32.to_le_bytes());
            }
        }
        out
    }

    /// Writes the same model as text.
    pub fn write_text(&self, folder: &Path) {
        let names = [
            "SIMPLE_PINHOLE",
            "PINHOLE",
            "SIMPLE_RADIAL",
            "RADIAL",
            "OPENCV",
            "OPENCV_FISHEYE",
            "FULL_OPENCV",
            "FOV",
            "SIMPLE_RADIAL_FISHEYE",
            "RADIAL_FISHEYE",
            "",
            "",
            "",
            "",
            "SIMPLE_FISHEYE",
            "FISHEYE",
        ];
        let mut cameras = String::from("# Camera list\n#   CAMERA_ID, MODEL, ...\n");
        for (id, model, width, height, parameters) in &self.cameras {
            write!(cameras, "{id} {} {width} {height}", names[*model as usize]).unwrap();
            for parameter in parameters {
                write!(cameras, " {parameter}").unwrap();
            }
            cameras.push('\n');
        }
        let mut images = String::from("# Image list with two lines of data per image:\n");
        for (index, (id, q, t, camera, name)) in self.images.iter().enumerate() {
            writeln!(
                images,
                "{id} {} {} {} {} {} {} {} {camera} {name}",
                q[0], q[1], q[2], q[3], t[0], t[1], t[2]
            )
            .unwrap();
            // An image without keypoints has an empty second line.
            let keypoints = [
                format!("1.5 2.5 -1 3.0 4.0 {SEEN} 5.0 4 12.0\n"),
                "\n".into(),
            ];
            images.push_str(&keypoints[index % 2]);
        }
        let mut points = String::from("# 3D point list\n");
        for (id, Point { position, color }) in &self.points {
            writeln!(
                points,
                "{id} {} {} {} {} {} {} 0.5 100 0 99 1",
                position[0], position[1], position[2], color[0], color[1], color[2]
            )
            .unwrap();
        }
        std::fs::create_dir_all(folder).unwrap();
        std::fs::write(folder.join("cameras.txt"), cameras).unwrap();
        std::fs::write(folder.join("images.txt"), images).unwrap();
        std::fs::write(folder.join("points3D.txt"), points).unwrap();
    }
}
