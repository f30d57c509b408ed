//! A capture of grey photos from the contents of a capture's files, for callers without a folder:
//! fuzz targets and their regression tests.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::colmap;
use super::random_points::Room;
use super::sparse_model::{SparseImage, SparseModel};
use super::{
    Capture, CaptureError, CaptureWarning, Point, Split, View, images, points_file, random_points,
    transforms,
};
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
    colmap::parse_model(binary, files).map(capture)
}

/// Reads and checks a `transforms.json`, or a file of Blender's with another name, from its
/// contents.
///
/// # Errors
/// Those of the reader, see [`CaptureError`].
pub fn parse_transforms(name: &str, contents: &[u8]) -> Result<Capture, CaptureError> {
    transforms::parse_model(Path::new(name), contents).map(capture)
}

/// Reads the points of a PLY file from its contents.
///
/// # Errors
/// Those of the reader, see [`CaptureError`].
pub fn parse_points(name: &str, contents: &[u8]) -> Result<Vec<Point>, CaptureError> {
    points_file::parse(Path::new(name), contents)
}

fn capture((mut model, warnings): (SparseModel, Vec<CaptureWarning>)) -> Capture {
    let mut photos = HashMap::new();
    let mut views = Vec::with_capacity(model.images.len());
    for image in &model.images {
        let mut view = view(&model, image);
        // One photo for all views of a size.
        let grey = || Arc::new(vec![128; 3 * view.pixel_count()]);
        view.image = photos
            .entry([view.width, view.height])
            .or_insert_with(grey)
            .clone();
        views.push(view);
    }
    if model.points.is_empty() {
        let cameras: Vec<Camera> = views.iter().map(View::camera).collect();
        let room = model.room.unwrap_or_else(|| Room::of_cameras(&cameras));
        model.points = random_points::draw(room, FEW_POINTS);
    }
    Capture {
        name: "memory".into(),
        root: PathBuf::from("memory"),
        photos: PathBuf::from("memory"),
        split: Split {
            train: (0..views.len()).collect(),
            test: vec![],
        },
        views,
        points: model.points,
        observations: model.observations,
        background: model.background,
        warnings,
    }
}

fn view(model: &SparseModel, image: &SparseImage) -> View {
    let camera = &model.cameras[&image.camera_id];
    let side = |length: u32| length.clamp(images::MIN_SIDE, LARGEST_SIDE);
    let size = camera.intrinsics.size().unwrap_or([LARGEST_SIDE; 2]);
    let [width, height] = size.map(side);
    // As for photos of another size, but with any aspect ratio.
    let intrinsics = camera.intrinsics.fit(size).unwrap_or([1.0; 4]);
    View {
        name: image.name.clone(),
        width,
        height,
        intrinsics,
        viewmat: image.viewmat,
        lens: camera.lens,
        image: Arc::default(),
        mask: None,
        depth: None,
        on_disk: None,
    }
}
