//! A small COLMAP model, and its two encodings.

use std::fmt::Write;

use super::Input;

/// A camera: id, model number, width, height, parameters.
type Camera = (u32, i32, u64, u64, Vec<f64>);
/// An image: id, quaternion, translation, camera's id, name, keypoints (x, y, point).
type Image = (u32, [f64; 4], [f64; 3], u32, String, Vec<(f64, f64, i64)>);
/// A point: id, position, colour, track (image, keypoint).
type Point = (u64, [f64; 3], [u8; 3], Vec<(u32, u32)>);

/// Contents of the three files.
pub(super) struct Model {
    cameras: Vec<Camera>,
    images: Vec<Image>,
    points: Vec<Point>,
}

impl Model {
    /// Three cameras, two of them pinholes and one with distortion; five images; six points.
    pub(super) fn small() -> Self {
        let keypoints = |i: u32| {
            let keypoint = |k: u32| (f64::from(k) + 1.5, 2.5, i64::from(k) - 1);
            (0..i % 3).map(keypoint).collect()
        };
        Self {
            cameras: vec![
                (7, 1, 24, 18, vec![30.0, 31.0, 12.0, 9.0]),
                (2, 0, 16, 20, vec![25.0, 8.0, 10.0]),
                (
                    3,
                    4,
                    20,
                    16,
                    vec![30.0, 31.0, 10.0, 8.0, -0.1, 0.01, 1e-3, 0.0],
                ),
            ],
            images: (0..5)
                .map(|i| {
                    let turn = f64::from(i) * 0.2;
                    let name = format!("{}view {i}.png", ["", "left/"][i as usize % 2]);
                    let quaternion = [turn.cos(), 0.0, turn.sin(), 0.0];
                    let camera = [7, 2, 3][i as usize % 3];
                    (
                        i + 1,
                        quaternion,
                        [turn, -0.1, 4.0],
                        camera,
                        name,
                        keypoints(i),
                    )
                })
                .collect(),
            points: (0..6)
                .map(|i| {
                    let x = i as f64 / 3.0 - 1.0;
                    let track = (0..i as u32 % 3).map(|k| (k + 1, k)).collect();
                    (i + 10, [x, -x * x, 0.5 * x], [40 * i as u8, 255, 7], track)
                })
                .collect(),
        }
    }

    /// cameras.bin, images.bin, points3D.bin.
    pub(super) fn binary(&self) -> Input {
        let count = |len: usize| (len as u64).to_le_bytes().to_vec();
        let mut cameras = count(self.cameras.len());
        for (id, model, width, height, parameters) in &self.cameras {
            cameras.extend(id.to_le_bytes());
            cameras.extend(model.to_le_bytes());
            cameras.extend(width.to_le_bytes());
            cameras.extend(height.to_le_bytes());
            cameras.extend(parameters.iter().flat_map(|p| p.to_le_bytes()));
        }
        let mut images = count(self.images.len());
        for (id, quaternion, translation, camera, name, keypoints) in &self.images {
            images.extend(id.to_le_bytes());
            images.extend(
                quaternion
                    .iter()
                    .chain(translation)
                    .flat_map(|x| x.to_le_bytes()),
            );
            images.extend(camera.to_le_bytes());
            images.extend(name.as_bytes());
            images.push(0);
            images.extend(count(keypoints.len()));
            for (x, y, point) in keypoints {
                images.extend([x.to_le_bytes(), y.to_le_bytes(), point.to_le_bytes()].concat());
            }
        }
        let mut points = count(self.points.len());
        for (id, position, color, track) in &self.points {
            points.extend(id.to_le_bytes());
            points.extend(position.iter().flat_map(|x| x.to_le_bytes()));
            points.extend(color);
            points.extend(0.5f64.to_le_bytes());
            points.extend(count(track.len()));
            for (image, keypoint) in track {
                points.extend([image.to_le_bytes(), keypoint.to_le_bytes()].concat());
            }
        }
        Input(vec![cameras, images, points])
    }

    /// cameras.txt, images.txt, points3D.txt.
    pub(super) fn text(&self) -> Input {
        let mut cameras = String::from(
            "# Camera list with one line of data per camera:\n# Number of cameras: 3\n",
        );
        for (id, model, width, height, parameters) in &self.cameras {
            let models = [
                "SIMPLE_PINHOLE",
                "PINHOLE",
                "SIMPLE_RADIAL",
                "RADIAL",
                "OPENCV",
            ];
            let model = models[*model as usize];
            writeln!(
                cameras,
                "{id} {model} {width} {height} {}",
                joined(parameters)
            )
            .expect("a string");
        }
        let mut images = String::from(
            "# Image list with two lines of data per image:\n# Number of images: 5, mean observations per image: 1\n",
        );
        for (id, quaternion, translation, camera, name, keypoints) in &self.images {
            let pose = [&quaternion[..], &translation[..]].concat();
            writeln!(images, "{id} {} {camera} {name}", joined(&pose)).expect("a string");
            let keypoints: Vec<_> = keypoints
                .iter()
                .map(|(x, y, point)| format!("{x} {y} {point}"))
                .collect();
            writeln!(images, "{}", keypoints.join(" ")).expect("a string");
        }
        let mut points = String::from(
            "# 3D point list with one line of data per point:\n# Number of points: 6\n",
        );
        for (id, position, [r, g, b], track) in &self.points {
            write!(points, "{id} {} {r} {g} {b} 0.5", joined(position)).expect("a string");
            for (image, keypoint) in track {
                write!(points, " {image} {keypoint}").expect("a string");
            }
            points.push('\n');
        }
        Input([cameras, images, points].map(String::into_bytes).to_vec())
    }
}

fn joined(numbers: &[f64]) -> String {
    numbers
        .iter()
        .map(f64::to_string)
        .collect::<Vec<_>>()
        .join(" ")
}
