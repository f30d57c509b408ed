//! A capture of grey photos from the contents of a model's files, for callers without a folder:
//! fuzz targets and their regression tests.

use std::path::PathBuf;
use std::sync::Arc;

use super::colmap;
use super::random_points::Room;
use super::sparse_model::{Intrinsics, SparseImage, SparseModel};
use super::{Capture, CaptureError, Split, View, images, random_points};
use crate::Camera;

/// Photos have the size of their camera, up to this limit.
const LARGEST_SIDE: u32 = 24;
/// Random points of a capture without points.
const FEW_POINTS: usize = 16;

/// Reads and checks a model, binary or text, from the contents of its cameras, images and points.
///
/// # Errors
/// Those of the readers, see [`CaptureError`].
pub fn parse(binary: bool, files: [&[u8]; 3]) -> Result<Capture, CaptureError> {
    let (mut model, warnings) = colmap::parse_model(binary, files)?;
    let views: Vec<View> = model.images.iter().map(|i| view(&model, i)).collect();
    if model.points.is_empty() {
        let cameras: Vec<Camera> = views.iter().map(View::camera).collect();
        model.points = random_points::draw(Room::of_cameras(&cameras), FEW_POINTS);
    }
    Ok(Capture {
        name: "memory".into(),
        root: PathBuf::from("memory"),
        photos: PathBuf::from("memory"),
        split: Split {
            train: (0..views.len()).collect(),
            test: vec![],
        },
        views,
        points: model.points,
        background: None,
        warnings,
    })
}

fn view(model: &SparseModel, image: &SparseImage) -> View {
    let camera = &model.cameras[&image.camera_id];
    let side = |length: u32| length.clamp(images::MIN_SIDE, LARGEST_SIDE);
    let Intrinsics::Pixels { size, values } = camera.intrinsics;
    let [width, height] = size.map(side);
    View {
        name: image.name.clone(),
        width,
        height,
        intrinsics: values,
        viewmat: image.viewmat,
        lens: camera.lens,
        image: Arc::new(vec![128; 3 * width as usize * height as usize]),
        mask: None,
        depth: None,
    }
}
