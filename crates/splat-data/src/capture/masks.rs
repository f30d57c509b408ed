//! Masks: which pixels of a photo count.
//!
//! A mask is 0 where a pixel is ignored, and 255 where it counts. It is the product of a photo's
//! alpha channel and of its mask file: the one that the capture names, or else the one in the
//! folder of masks that has the photo's name.

use std::path::{Path, PathBuf};

use super::photo_file::{PhotoFile, rgb_and_alpha};
use super::sparse_model::SparseImage;
use super::{CaptureError, CaptureWarning};

/// Files with masks.
#[derive(Debug)]
pub(super) struct Masks {
    folder: Option<PathBuf>,
}

impl Masks {
    /// The folder of masks beside that of the photos: `masks`, or `masks_4` for photos in
    /// `images_4`.
    pub fn beside(root: &Path, photos: &Path) -> Self {
        let name = photos.file_name().unwrap_or_default().to_string_lossy();
        let suffix = name.strip_prefix("images").unwrap_or_default();
        let folders = [root.join(format!("masks{suffix}")), root.join("masks")];
        Self {
            folder: folders.into_iter().find(|folder| folder.is_dir()),
        }
    }

    /// The mask of an image: named by the capture, or else `NAME.EXT.png` (COLMAP's convention) or
    /// `NAME.png` in the folder of masks.
    pub fn file(&self, image: &SparseImage) -> Option<PathBuf> {
        if image.mask.is_some() {
            return image.mask.clone();
        }
        let folder = self.folder.as_ref()?;
        let appended = folder.join(format!("{}.png", image.name));
        let replaced = folder.join(&image.name).with_extension("png");
        [appended, replaced].into_iter().find(|path| path.is_file())
    }

    /// True if any of the images may have a mask file.
    pub fn any(&self, images: &[SparseImage]) -> bool {
        self.folder.is_some() || images.iter().any(|image| image.mask.is_some())
    }

    /// Photos without a mask although there is a folder of masks.
    pub fn missing(&self, images: &[SparseImage]) -> Option<CaptureWarning> {
        let folder = self.folder.clone()?;
        let mut bare = images.iter().filter(|image| self.file(image).is_none());
        let first = bare.next()?.name.clone();
        Some(CaptureWarning::PhotosWithoutMask {
            folder,
            count: 1 + bare.count(),
            photos: images.len(),
            first,
        })
    }
}

/// Reads the mask of a photo of this size.
pub(super) fn read(mask: &Path, photo: &Path, size: [u32; 2]) -> Result<Vec<u8>, CaptureError> {
    let mut file = PhotoFile::open(mask)?;
    let mask_size = file.size(mask)?;
    if mask_size != size {
        return Err(CaptureError::MaskSize {
            mask: mask.to_path_buf(),
            mask_size,
            photo: photo.to_path_buf(),
            photo_size: size,
        });
    }
    file.check_whole(mask)?;
    let picture = file.decode(mask)?;
    let grey = picture.to_luma8().into_raw();
    let (_, alpha) = rgb_and_alpha(picture);
    let mut mask = combined(Some(grey), alpha).unwrap_or_default();
    // Some programs write what counts as 1.
    if mask.iter().all(|&value| value <= 1) {
        for value in &mut mask {
            *value *= 255;
        }
    }
    Ok(mask)
}

/// The product of two masks; `None` if neither ignores anything.
pub(super) fn combined(a: Option<Vec<u8>>, b: Option<Vec<u8>>) -> Option<Vec<u8>> {
    let (Some(mut mask), Some(other)) = (a.clone(), b.clone()) else {
        return a.or(b);
    };
    for (value, other) in mask.iter_mut().zip(other) {
        *value = ((u32::from(*value) * u32::from(other) + 127) / 255) as u8;
    }
    Some(mask)
}
