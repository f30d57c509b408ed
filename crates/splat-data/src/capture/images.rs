//! Photos: found, matched to their cameras, and decoded in parallel, or left on the disk.

mod folders;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;
use splat_core::memory::available_memory;

use super::masks::Masks;
use super::on_disk::PhotoOnDisk;
use super::photo_loader::{Loaded, Loader};
use super::photo_memory::too_much;
use super::sparse_model::SparseModel;
use super::{CaptureError, CaptureSettings, CaptureWarning, Progress, View};

/// Smallest width and height of a photo: the window of SSIM.
pub(super) const MIN_SIDE: u32 = 11;

/// The folder of the photos.
pub(super) fn folder(
    root: &Path,
    model: &SparseModel,
    options: &CaptureSettings,
) -> Result<PathBuf, CaptureError> {
    match (&model.photos, &options.images) {
        (Some(folder), None) => Ok(folder.clone()),
        (_, given) => folders::of_photos(root, given.as_deref(), model),
    }
}

/// Loads the photo of every image of the model, or looks at it if all would need too much memory.
/// The views are in the order of the model's images.
pub(super) fn load(
    root: &Path,
    folder: &Path,
    model: &SparseModel,
    options: &CaptureSettings,
    progress: Progress<'_>,
    warnings: &mut Vec<CaptureWarning>,
) -> Result<Vec<View>, CaptureError> {
    // Look for every photo before decoding any, so that the likeliest mistake is found at once.
    for image in &model.images {
        let path = folder.join(&image.name);
        if !path.is_file() {
            return Err(CaptureError::MissingPhoto {
                path,
                image: image.name.clone(),
                elsewhere: folders::elsewhere(root, folder, model),
            });
        }
    }
    let loader = Arc::new(Loader {
        folder: folder.to_path_buf(),
        masks: Masks::beside(root, folder),
        factor: options.downscale,
        background: model.background,
    });
    let streamed = too_much(root, &loader, model, options.memory, available_memory())?;
    warnings.extend(streamed.clone());
    let (done, total) = (AtomicUsize::new(0), model.images.len());
    let loaded: Vec<Result<Loaded, CaptureError>> = model
        .images
        .par_iter()
        .map(|image| {
            let camera = &model.cameras[&image.camera_id];
            let loaded = match streamed {
                Some(_) => PhotoOnDisk::look(&loader, image, camera),
                None => loader.load(image, camera),
            };
            progress(done.fetch_add(1, Ordering::Relaxed) + 1, total);
            loaded
        })
        .collect();
    let loaded = loaded.into_iter().collect::<Result<Vec<_>, _>>()?;
    let rescaled =
        (loaded.iter()).filter_map(|loaded| Some((&*loaded.view.name, loaded.rescaled?)));
    warnings.extend(CaptureWarning::rescaled(rescaled));
    let found = |kind: fn(&Loaded) -> bool| {
        let mut odd = loaded.iter().filter(|loaded| kind(loaded));
        let first = odd.next()?.view.name.clone();
        Some((1 + odd.count(), first))
    };
    let transparent = found(|loaded| loaded.transparent);
    let damaged = found(|loaded| loaded.suspect);
    let empty = found(|loaded| loaded.empty_mask);
    warnings.extend(
        transparent.map(|(count, first)| CaptureWarning::TransparentPhotos { count, first }),
    );
    warnings.extend(damaged.map(|(count, first)| CaptureWarning::DamagedPhotos { count, first }));
    warnings.extend(empty.map(|(count, first)| CaptureWarning::EmptyMasks { count, first }));
    warnings.extend(loader.masks.missing(&model.images));
    // Blender writes depth and normals beside its pictures.
    if model.background.is_none() {
        warnings.extend(folders::unregistered(root, folder, model));
    }
    Ok(loaded.into_iter().map(|loaded| loaded.view).collect())
}
