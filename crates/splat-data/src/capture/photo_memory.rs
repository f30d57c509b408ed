//! The memory that decoded photos need, against a bound.

use std::path::Path;

use rayon::prelude::*;

use super::photo_file::size_of;
use super::photo_loader::Loader;
use super::sparse_model::{SparseImage, SparseModel};
use super::{CaptureError, CaptureWarning};

/// Share of the memory left that photos may take by default: one over this.
const SHARE: u64 = 2;
/// Photos may differ in size from their cameras. Looking at each takes time, and is skipped if the
/// bound is this many times what the cameras' sizes need.
const AMPLE: u64 = 64;

/// The warning that photos stay on the disk, if they would need more memory than `bound`, by
/// default half of what is `left`.
///
/// # Errors
///
/// [`CaptureError::OutOfMemory`] if one photo alone does not fit; a failed allocation would end the
/// process.
pub(super) fn too_much(
    root: &Path,
    loader: &Loader,
    model: &SparseModel,
    bound: Option<u64>,
    left: Option<u64>,
) -> Result<Option<CaptureWarning>, CaptureError> {
    let bound = bound.or(left.map(|left| left / SHARE));
    let Some(bound) = bound.map(|bound| bound.min(left.unwrap_or(u64::MAX))) else {
        return Ok(None);
    };
    let masked = loader.masks.any(&model.images);
    let bytes = |sides: [u32; 2], factor: u32| {
        let [width, height] = sides.map(|side| u64::from(side.div_ceil(factor)));
        width
            .saturating_mul(height)
            .saturating_mul(if masked { 4 } else { 3 })
    };
    let of_camera = |image: &SparseImage| {
        let size = model.cameras[&image.camera_id].intrinsics.size();
        size.map_or(u64::MAX, |size| bytes(size, loader.factor))
    };
    let by_cameras = model.images.iter().map(of_camera);
    if by_cameras.fold(0, u64::saturating_add) <= bound / AMPLE {
        return Ok(None);
    }
    // Unreadable photos are reported when they are decoded.
    let of_photo = |image: &SparseImage| {
        let size = size_of(&loader.folder.join(&image.name)).unwrap_or([0, 0]);
        (bytes(size, loader.factor), bytes(size, 1))
    };
    let photos = model.images.par_iter().map(of_photo);
    let (needed, largest) =
        photos.reduce(|| (0, 0), |a, b| (a.0.saturating_add(b.0), a.1.max(b.1)));
    if let Some(left) = left.filter(|left| largest > *left) {
        return Err(CaptureError::OutOfMemory {
            root: root.to_path_buf(),
            needed: largest,
            left,
        });
    }
    Ok((needed > bound).then_some(CaptureWarning::PhotosOnDisk {
        photos: model.images.len(),
        needed,
        bound,
    }))
}
