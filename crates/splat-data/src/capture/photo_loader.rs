//! One photo with its mask and camera, decoded, composited and downscaled.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::images::MIN_SIDE;
use super::masks::{self, Masks};
use super::photo_file::{PhotoFile, rgb_and_alpha};
use super::sparse_model::{SparseCamera, SparseImage};
use super::{CaptureError, View, downscale};

/// A view with the warnings about its photo.
pub(super) struct Loaded {
    pub view: View,
    /// True if alpha masks a part of the photo.
    pub transparent: bool,
    /// True if the mask ignores the whole photo.
    pub empty_mask: bool,
    /// True if the file is likely damaged, although its picture is complete.
    pub suspect: bool,
    /// Sizes of photo and camera if they differ.
    pub rescaled: Option<[[u32; 2]; 2]>,
}

/// What all photos of a capture have in common.
#[derive(Debug)]
pub(super) struct Loader {
    pub folder: PathBuf,
    pub masks: Masks,
    /// Factor by which photos are area-averaged.
    pub factor: u32,
    /// Colour behind transparent pixels; `None` if alpha is a mask.
    pub background: Option<[f32; 3]>,
}

impl Loader {
    /// Decodes the photo of an image.
    pub fn load(&self, image: &SparseImage, camera: &SparseCamera) -> Result<Loaded, CaptureError> {
        let path = self.folder.join(&image.name);
        let mut file = PhotoFile::open(&path)?;
        let size = file.size(&path)?;
        let mut loaded = self.placed(image, camera, &path, size)?;
        loaded.suspect = file.check_whole(&path)?;
        let (mut pixels, mut alpha) = rgb_and_alpha(file.decode(&path)?);
        if let Some(background) = self.background
            && let Some(alpha) = alpha.take()
        {
            composite(&mut pixels, &alpha, background);
        }
        loaded.transparent = alpha.is_some();
        let mask = self.masks.file(image);
        let mask = mask.map(|mask| masks::read(&mask, &path, size));
        let mut mask = masks::combined(alpha, mask.transpose()?);
        if self.factor > 1 {
            let [width, height] = size;
            let whole = downscale::Picture {
                pixels: &pixels,
                mask: mask.as_deref(),
                width,
                height,
            };
            (pixels, mask) = downscale::area_average(&whole, self.factor);
        }
        let mask = mask.filter(|mask| mask.iter().any(|&value| value != 255));
        loaded.empty_mask = mask
            .as_ref()
            .is_some_and(|mask| mask.iter().all(|&value| value == 0));
        loaded.view.image = Arc::new(pixels);
        loaded.view.mask = mask.map(Arc::new);
        Ok(loaded)
    }

    /// The view of a photo of this size, without its pixels.
    pub fn placed(
        &self,
        image: &SparseImage,
        camera: &SparseCamera,
        path: &Path,
        size: [u32; 2],
    ) -> Result<Loaded, CaptureError> {
        let camera_size = camera.intrinsics.size().unwrap_or(size);
        let Some(mut intrinsics) = camera.intrinsics.fit(size) else {
            return Err(CaptureError::PhotoSize {
                path: path.to_path_buf(),
                photo: size,
                camera_id: camera.id,
                camera: camera_size,
            });
        };
        if self.factor > 1 {
            intrinsics = downscale::intrinsics(intrinsics, self.factor);
        }
        let [width, height] = size.map(|side| side / self.factor);
        if width < MIN_SIDE || height < MIN_SIDE {
            return Err(CaptureError::PhotoTooSmall {
                path: path.to_path_buf(),
                size: [width, height],
                downscale: self.factor,
                min: MIN_SIDE,
            });
        }
        Ok(Loaded {
            view: View {
                name: image.name.clone(),
                width,
                height,
                intrinsics,
                viewmat: image.viewmat,
                lens: camera.lens,
                image: Arc::default(),
                mask: None,
                depth: image.depth.clone(),
                on_disk: None,
            },
            transparent: false,
            empty_mask: false,
            suspect: false,
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
