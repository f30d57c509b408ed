//! Photos: found, decoded once in parallel, matched to their cameras, and kept as 8-bit RGB.

mod folders;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use image::ImageReader;
use rayon::prelude::*;
use splat_core::memory::available_memory;

use super::masks::{self, Masks};
use super::photo_file::{PhotoFile, rgb_and_alpha};
use super::sparse_model::{SparseCamera, SparseImage, SparseModel};
use super::{CaptureError, CaptureSettings, CaptureWarning, Progress, View, downscale};

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

/// Loads the photo of every image of the model. The views are in the order of the model's images.
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
    check_memory(root, folder, model, options.downscale, available_memory())?;
    let loader = Loader {
        folder,
        masks: Masks::beside(root, folder),
        factor: options.downscale,
        background: model.background,
    };
    let (done, total) = (AtomicUsize::new(0), model.images.len());
    let loaded: Vec<Result<Loaded, CaptureError>> = model
        .images
        .par_iter()
        .map(|image| {
            let loaded = loader.load(image, &model.cameras[&image.camera_id]);
            progress(done.fetch_add(1, Ordering::Relaxed) + 1, total);
            loaded
        })
        .collect();
    let loaded = loaded.into_iter().collect::<Result<Vec<_>, _>>()?;
    warnings.extend(rescaled(&loaded));
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

/// Refuses photos that would not fit into memory; a failed allocation would end the process.
pub(super) fn check_memory(
    root: &Path,
    folder: &Path,
    model: &SparseModel,
    factor: u32,
    left: Option<u64>,
) -> Result<(), CaptureError> {
    let bytes = |sides: [u32; 2]| {
        let [width, height] = sides.map(|side| u64::from(side.div_ceil(factor)));
        width.saturating_mul(height).saturating_mul(3)
    };
    let of_camera = |image: &SparseImage| {
        let camera = &model.cameras[&image.camera_id];
        camera.intrinsics.size().map_or(u64::MAX, bytes)
    };
    let Some(left) = left else { return Ok(()) };
    // Photos may differ in size from their cameras. Looking at each takes time and is skipped if
    // memory is ample.
    const AMPLE: u64 = 64;
    let by_cameras = model.images.iter().map(of_camera);
    if by_cameras.fold(0, u64::saturating_add) <= left / AMPLE {
        return Ok(());
    }
    let size = |path: &Path| -> Option<(u32, u32)> {
        let reader = ImageReader::open(path).ok()?;
        // Detects the format from the contents, not the name.
        reader.with_guessed_format().ok()?.into_dimensions().ok()
    };
    // Unreadable photos are reported when they are decoded.
    let of_photo = |image: &SparseImage| {
        size(&folder.join(&image.name)).map_or(0, |(width, height)| bytes([width, height]))
    };
    let photos = model.images.par_iter().map(of_photo);
    let needed = photos.reduce(|| 0, u64::saturating_add);
    if needed <= left {
        return Ok(());
    }
    Err(CaptureError::OutOfMemory {
        root: root.to_path_buf(),
        photos: model.images.len(),
        needed,
        left,
        downscale: factor,
    })
}

/// A view with the warnings about its photo.
struct Loaded {
    view: View,
    /// True if alpha masks a part of the photo.
    transparent: bool,
    /// True if the mask ignores the whole photo.
    empty_mask: bool,
    /// True if the file is likely damaged, although its picture is complete.
    suspect: bool,
    /// Sizes of photo and camera if they differ.
    rescaled: Option<[[u32; 2]; 2]>,
}

/// What all photos of a capture have in common.
struct Loader<'a> {
    folder: &'a Path,
    masks: Masks,
    factor: u32,
    /// Colour behind transparent pixels; `None` if alpha is a mask.
    background: Option<[f32; 3]>,
}

impl Loader<'_> {
    fn load(&self, image: &SparseImage, camera: &SparseCamera) -> Result<Loaded, CaptureError> {
        let path = self.folder.join(&image.name);
        let mut file = PhotoFile::open(&path)?;
        let size = file.size(&path)?;
        let camera_size = camera.intrinsics.size().unwrap_or(size);
        let Some(mut intrinsics) = camera.intrinsics.fit(size) else {
            return Err(CaptureError::PhotoSize {
                path,
                photo: size,
                camera_id: camera.id,
                camera: camera_size,
            });
        };
        let suspect = file.check_whole(&path)?;
        let (mut pixels, mut alpha) = rgb_and_alpha(file.decode(&path)?);
        if let Some(background) = self.background
            && let Some(alpha) = alpha.take()
        {
            composite(&mut pixels, &alpha, background);
        }
        let transparent = alpha.is_some();
        let mask = self
            .masks
            .file(image)
            .map(|mask| masks::read(&mask, &path, size));
        let mut mask = masks::combined(alpha, mask.transpose()?);
        let [mut width, mut height] = size;
        if self.factor > 1 {
            let whole = downscale::Picture {
                pixels: &pixels,
                mask: mask.as_deref(),
                width,
                height,
            };
            (pixels, mask) = downscale::area_average(&whole, self.factor);
            [width, height] = size.map(|side| side / self.factor);
            intrinsics = downscale::intrinsics(intrinsics, self.factor);
        }
        if width < MIN_SIDE || height < MIN_SIDE {
            return Err(CaptureError::PhotoTooSmall {
                path,
                size: [width, height],
                downscale: self.factor,
                min: MIN_SIDE,
            });
        }
        let mask = mask.filter(|mask| mask.iter().any(|&value| value != 255));
        Ok(Loaded {
            empty_mask: mask
                .as_ref()
                .is_some_and(|mask| mask.iter().all(|&value| value == 0)),
            view: View {
                name: image.name.clone(),
                width,
                height,
                intrinsics,
                viewmat: image.viewmat,
                lens: camera.lens,
                image: Arc::new(pixels),
                mask: mask.map(Arc::new),
                depth: image.depth.clone(),
            },
            transparent,
            suspect,
            rescaled: (size != camera_size).then_some([size, camera_size]),
        })
    }
}

/// Puts pixels with alpha on a colour, rounded to the nearest.
fn composite(pixels: &mut [u8], alpha: &[u8], background: [f32; 3]) {
    let background = background.map(|value| (255.0 * value).round() as u32);
    for (pixel, &alpha) in pixels.chunks_exact_mut(3).zip(alpha) {
        let alpha = u32::from(alpha);
        for (value, background) in pixel.iter_mut().zip(background) {
            *value = ((u32::from(*value) * alpha + background * (255 - alpha) + 127) / 255) as u8;
        }
    }
}

fn rescaled(loaded: &[Loaded]) -> Option<CaptureWarning> {
    let mut odd = loaded
        .iter()
        .filter_map(|loaded| Some((&loaded.view.name, loaded.rescaled?)));
    let (first, [photo, camera]) = odd.next()?;
    Some(CaptureWarning::RescaledPhotos {
        count: 1 + odd.count(),
        first: first.clone(),
        photo,
        camera,
    })
}
