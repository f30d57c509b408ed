//! A capture of grey photos from the contents of a model's files, for callers without a folder:
//! fuzz targets and their regression tests.

use std::path::PathBuf;
use std::sync::Arc;

use splat_core::Lens;

use super::colmap;
use super::sparse_model::{SparseImage, SparseModel};
use super::{Capture, CaptureError, Split, View, images};

/// Photos have the size of their camera, up to this limit.
const LARGEST_SIDE: u32 = 24;

/// Reads and checks a model, binary or text, from the contents of its cameras, images and points.
///
/// # Errors
/// Those of the readers, see [`CaptureError`].
pub fn parse(binary: bool, files: [&[u8]; 3]) -> Result<Capture, CaptureError> {
    let (model, warnings) = colmap::parse_model(binary, files)?;
    let views: Vec<View> = model.images.iter().map(|i| view(&model, i)).collect();
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
        warnings,
    })
}

fn view(model: &SparseModel, image: &SparseImage) -> View {
    let camera = &model.cameras[&image.camera_id];
    let side = |length: u32| length.clamp(images::MIN_SIDE, LARGEST_SIDE);
    let (width, height) = (side(camera.width), side(camera.height));
    View {
        name: image.name.clone(),
        width,
        height,
        intrinsics: camera.intrinsics,
        viewmat: image.viewmat(),
        lens: Lens::Pinhole,
        image: Arc::new(vec![128; 3 * width as usize * height as usize]),
        mask: None,
    }
}
