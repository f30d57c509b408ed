//! Consistency checks of a COLMAP model's records, and their common form.

use std::collections::{HashMap, HashSet};
use std::path::Path;

use splat_core::CameraModel;

use super::colmap_records::{ColmapCamera, ColmapImage, ColmapPoint};
use super::sparse_model::{Intrinsics, SparseCamera, SparseImage, SparseModel, viewmat};
use super::{CaptureError, Observation};
use crate::text::Excerpt;

/// Length in bytes of the longest path that systems accept.
const MOST_NAME: usize = 4096;

/// Checks the three lists individually and against each other.
pub(super) fn assemble(
    [cameras_file, images_file, points_file]: [&Path; 3],
    cameras: Vec<ColmapCamera>,
    mut images: Vec<ColmapImage>,
    points: Vec<ColmapPoint>,
) -> Result<SparseModel, CaptureError> {
    let mut by_id = HashMap::with_capacity(cameras.len());
    for camera in cameras {
        let bad = |reason| CaptureError::BadRecord {
            path: cameras_file.to_path_buf(),
            record: format!("camera {}", camera.id),
            reason,
        };
        check_camera(&camera).map_err(bad)?;
        if by_id.insert(camera.id, camera).is_some() {
            return Err(bad("its id occurs twice".to_owned()));
        }
    }

    if images.is_empty() {
        return Err(CaptureError::NoImages {
            path: images_file.to_path_buf(),
        });
    }
    let mut names = HashSet::with_capacity(images.len());
    for image in &images {
        let unique = names.insert(image.name.as_str());
        check_image(image, &by_id, unique).map_err(|reason| CaptureError::BadRecord {
            path: images_file.to_path_buf(),
            record: format!("image {} (`{}`)", image.id, Excerpt(&image.name)),
            reason,
        })?;
    }
    drop(names);
    images.sort_by(|a, b| a.name.cmp(&b.name));

    let is_finite = |point: &ColmapPoint| point.point.position.iter().all(|x| x.is_finite());
    if let Some(index) = points.iter().position(|point| !is_finite(point)) {
        return Err(CaptureError::BadRecord {
            path: points_file.to_path_buf(),
            record: format!("point {index} (counted from 0)"),
            reason: format!(
                "its position {:?} is not finite",
                points[index].point.position
            ),
        });
    }
    Ok(SparseModel {
        observations: observations([images_file, points_file], &by_id, &images, &points)?,
        cameras: by_id.into_iter().map(|(id, c)| (id, sparse(c))).collect(),
        images: images.into_iter().map(image).collect(),
        points: points.into_iter().map(|point| point.point).collect(),
        ..SparseModel::default()
    })
}

/// The keypoints of the images, sorted by image. Those of points that the model does not have, as
/// after points were removed, are left out.
fn observations(
    [images_file, points_file]: [&Path; 2],
    cameras: &HashMap<u32, ColmapCamera>,
    images: &[ColmapImage],
    points: &[ColmapPoint],
) -> Result<Vec<Observation>, CaptureError> {
    if images.iter().all(|image| image.keypoints.is_empty()) {
        return Ok(vec![]);
    }
    let index = |(index, point): (usize, &ColmapPoint)| (point.id, index as u32);
    let by_id: HashMap<u64, u32> = points.iter().enumerate().map(index).collect();
    if by_id.len() < points.len() {
        let twice = (points.iter().enumerate())
            .find(|(at, point)| by_id.get(&point.id).is_none_or(|last| *last != *at as u32));
        let id = twice.map_or(0, |(_, point)| point.id);
        return Err(CaptureError::BadRecord {
            path: points_file.to_path_buf(),
            record: format!("point {id}"),
            reason: "its id occurs twice, and keypoints refer to it".to_owned(),
        });
    }
    let mut observations = Vec::new();
    for (view, image) in images.iter().enumerate() {
        let [fx, fy, cx, cy] = cameras[&image.camera_id].intrinsics;
        for (index, keypoint) in image.keypoints.iter().enumerate() {
            let Some(&point) = by_id.get(&keypoint.point_id) else {
                continue;
            };
            let [x, y] = keypoint.position;
            let position = [(x - cx) / fx, (y - cy) / fy];
            if !position.iter().all(|x| x.is_finite()) {
                return Err(CaptureError::BadRecord {
                    path: images_file.to_path_buf(),
                    record: format!("image {} (`{}`)", image.id, Excerpt(&image.name)),
                    reason: format!(
                        "the position {:?} of matched keypoint {index} (counted from 0) is not finite",
                        keypoint.position
                    ),
                });
            }
            observations.push(Observation {
                view: view as u32,
                point,
                position,
            });
        }
    }
    Ok(observations)
}

fn sparse(camera: ColmapCamera) -> SparseCamera {
    SparseCamera {
        id: camera.id,
        intrinsics: Intrinsics::Pixels {
            size: [camera.width, camera.height],
            values: camera.intrinsics,
        },
        lens: camera.lens,
    }
}

fn image(image: ColmapImage) -> SparseImage {
    SparseImage {
        id: image.id,
        camera_id: image.camera_id,
        viewmat: viewmat(image.quaternion, image.translation),
        name: image.name,
        mask: None,
        depth: None,
    }
}

fn check_camera(camera: &ColmapCamera) -> Result<(), String> {
    let [fx, fy, cx, cy] = camera.intrinsics;
    if camera.width == 0 || camera.height == 0 {
        return Err(format!("its size is {}x{}", camera.width, camera.height));
    }
    // Guards are written so that NaN fails them.
    let focal_ok = fx > 0.0 && fy > 0.0 && fx.is_finite() && fy.is_finite();
    if !focal_ok || !cx.is_finite() || !cy.is_finite() {
        return Err(format!(
            "its parameters fx {fx}, fy {fy}, cx {cx}, cy {cy} are no camera"
        ));
    }
    let coefficients = camera.lens.coefficients();
    if let Some(index) = coefficients.iter().position(|value| !value.is_finite()) {
        let model: CameraModel = camera.lens.model();
        return Err(format!(
            "its distortion coefficient {} is {}",
            model.coefficient_names()[index],
            coefficients[index]
        ));
    }
    Ok(())
}

fn check_image(
    image: &ColmapImage,
    cameras: &HashMap<u32, ColmapCamera>,
    unique: bool,
) -> Result<(), String> {
    if !unique {
        return Err("its name occurs twice".to_owned());
    }
    let is_odd = |c: char| c.is_control() && c != '\t';
    if image.name.chars().any(is_odd) || image.name.len() > MOST_NAME {
        return Err("its name is no file's name".to_owned());
    }
    if !stays_inside(&image.name) {
        return Err("its name leads out of the folder of photos".to_owned());
    }
    if !cameras.contains_key(&image.camera_id) {
        return Err(format!(
            "its camera {} is not among the cameras",
            image.camera_id
        ));
    }
    if !image.translation.iter().all(|x| x.is_finite()) {
        return Err(format!(
            "its translation {:?} is not finite",
            image.translation
        ));
    }
    let rotates = image.quaternion.iter().any(|q| *q != 0.0);
    if !(rotates && image.quaternion.iter().all(|q| q.is_finite())) {
        return Err(format!(
            "its quaternion {:?} is not a rotation",
            image.quaternion
        ));
    }
    Ok(())
}

/// True if a name, in the notation of any system, stays inside the folder that it is resolved in.
pub(super) fn stays_inside(name: &str) -> bool {
    let has_drive = matches!(name.as_bytes(), [drive, b':', ..] if drive.is_ascii_alphabetic());
    let from_root = has_drive || name.starts_with(['/', '\\']);
    let mut steps = name.split(['/', '\\']);
    !from_root && !name.contains('\0') && !steps.any(|step| step == "..")
}
