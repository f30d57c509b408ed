//! Photos: found, decoded once in parallel, matched to their cameras, and kept as 8-bit RGB.

mod folders;

use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::{DynamicImage, ImageError, ImageFormat, ImageReader};
use rayon::prelude::*;
use splat_core::memory::available_memory;

use super::sparse_model::{SparseCamera, SparseImage, SparseModel};
use super::{CaptureError, CaptureSettings, CaptureWarning, View, downscale, jpeg};

/// Smallest width and height of a photo: the window of SSIM.
pub(super) const MIN_SIDE: u32 = 11;

/// The folder of the photos.
pub(super) fn folder(
    root: &Path,
    model: &SparseModel,
    options: &CaptureSettings,
) -> Result<PathBuf, CaptureError> {
    folders::of_photos(root, options.images.as_deref(), model)
}

/// Loads the photo of every image of the model. The views are in the order of the model's images.
pub(super) fn load(
    root: &Path,
    folder: &Path,
    model: &SparseModel,
    options: &CaptureSettings,
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
    let factor = options.downscale;
    check_memory(root, folder, model, factor, available_memory())?;
    let loaded: Vec<Result<Loaded, CaptureError>> = model
        .images
        .par_iter()
        .map(|image| load_one(folder, image, &model.cameras[&image.camera_id], factor))
        .collect();
    let loaded = loaded.into_iter().collect::<Result<Vec<_>, _>>()?;
    warnings.extend(rescaled(&loaded));
    warnings.extend(transparent(&loaded));
    warnings.extend(damaged(&loaded));
    warnings.extend(folders::unregistered(root, folder, model));
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
    transparent: bool,
    /// True if the file is likely damaged, although its picture is complete.
    suspect: bool,
    /// Sizes of photo and camera if they differ.
    rescaled: Option<[[u32; 2]; 2]>,
}

fn load_one(
    folder: &Path,
    image: &SparseImage,
    camera: &SparseCamera,
    factor: u32,
) -> Result<Loaded, CaptureError> {
    let path = folder.join(&image.name);
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
    let photo = file.decode(&path)?;

    let (mut pixels, transparent) = opaque_rgb(photo);
    let [mut width, mut height] = size;
    if factor > 1 {
        (pixels, width, height) = downscale::area_average(&pixels, width, height, factor);
        intrinsics = downscale::intrinsics(intrinsics, factor);
    }
    if width < MIN_SIDE || height < MIN_SIDE {
        return Err(CaptureError::PhotoTooSmall {
            path,
            size: [width, height],
            downscale: factor,
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
            image: Arc::new(pixels),
            mask: None,
            depth: image.depth.clone(),
        },
        transparent,
        suspect,
        rescaled: (size != camera_size).then_some([size, camera_size]),
    })
}

/// A photo file in memory.
struct PhotoFile {
    bytes: Vec<u8>,
    format: ImageFormat,
}

impl PhotoFile {
    fn open(path: &Path) -> Result<Self, CaptureError> {
        let bytes = std::fs::read(path).map_err(|source| CaptureError::Io {
            path: path.to_path_buf(),
            source,
        })?;
        let format = image::guess_format(&bytes).map_err(|error| undecodable(path, &error))?;
        Ok(Self { bytes, format })
    }

    /// Width and height.
    fn size(&self, path: &Path) -> Result<[u32; 2], CaptureError> {
        let size = self.reader().into_dimensions();
        size.map(<[u32; 2]>::from)
            .map_err(|error| undecodable(path, &error))
    }

    /// Refuses a photo with a missing part that the decoder would accept; returns true if the file
    /// looks damaged anyway. (PNG files have checksums, which the decoder verifies.)
    fn check_whole(&mut self, path: &Path) -> Result<bool, CaptureError> {
        if self.format != ImageFormat::Jpeg {
            return Ok(false);
        }
        let whole = jpeg::check(&self.bytes).map_err(|reason| CaptureError::IncompletePhoto {
            path: path.to_path_buf(),
            reason,
        })?;
        if !whole.ended {
            // Without the end marker the decoder invents the last rows, although they are present.
            self.bytes.extend(jpeg::END);
        }
        Ok(whole.suspect)
    }

    /// The photo as stored. Like COLMAP, this ignores EXIF orientation.
    fn decode(&self, path: &Path) -> Result<DynamicImage, CaptureError> {
        self.reader()
            .decode()
            .map_err(|error| undecodable(path, &error))
    }

    fn reader(&self) -> ImageReader<Cursor<&[u8]>> {
        ImageReader::with_format(Cursor::new(&self.bytes), self.format)
    }
}

fn undecodable(path: &Path, error: &ImageError) -> CaptureError {
    CaptureError::UndecodablePhoto {
        path: path.to_path_buf(),
        reason: error.to_string().replace('\n', " "),
    }
}

/// 8-bit RGB with transparent pixels composited on black; and whether there were any.
fn opaque_rgb(photo: DynamicImage) -> (Vec<u8>, bool) {
    if !photo.color().has_alpha() {
        return (photo.into_rgb8().into_raw(), false);
    }
    let rgba = photo.into_rgba8();
    let transparent = rgba.pixels().any(|pixel| pixel.0[3] != 255);
    let on_black = |value: u8, alpha: u8| ((u32::from(value) * u32::from(alpha) + 127) / 255) as u8;
    let pixels = rgba
        .pixels()
        .flat_map(|pixel| {
            let [r, g, b, a] = pixel.0;
            [on_black(r, a), on_black(g, a), on_black(b, a)]
        })
        .collect();
    (pixels, transparent)
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

fn transparent(loaded: &[Loaded]) -> Option<CaptureWarning> {
    let mut odd = loaded.iter().filter(|loaded| loaded.transparent);
    let first = odd.next()?.view.name.clone();
    Some(CaptureWarning::TransparentPhotos {
        count: 1 + odd.count(),
        first,
    })
}

fn damaged(loaded: &[Loaded]) -> Option<CaptureWarning> {
    let mut odd = loaded.iter().filter(|loaded| loaded.suspect);
    let first = odd.next()?.view.name.clone();
    Some(CaptureWarning::DamagedPhotos {
        count: 1 + odd.count(),
        first,
    })
}
