//! A photo in a file: its size, whether it is whole, and its pixels.

use std::io::Cursor;
use std::path::Path;

use image::{DynamicImage, ImageError, ImageFormat, ImageReader};

use super::{CaptureError, jpeg};

/// A photo file in memory.
pub(super) struct PhotoFile {
    bytes: Vec<u8>,
    format: ImageFormat,
}

impl PhotoFile {
    pub fn open(path: &Path) -> Result<Self, CaptureError> {
        let bytes = std::fs::read(path).map_err(|source| CaptureError::Io {
            path: path.to_path_buf(),
            source,
        })?;
        let format = image::guess_format(&bytes).map_err(|error| undecodable(path, &error))?;
        Ok(Self { bytes, format })
    }

    /// Width and height.
    pub fn size(&self, path: &Path) -> Result<[u32; 2], CaptureError> {
        let size = self.reader().into_dimensions();
        size.map(<[u32; 2]>::from)
            .map_err(|error| undecodable(path, &error))
    }

    /// Refuses a photo with a missing part that the decoder would accept; returns true if the file
    /// looks damaged anyway. (PNG files have checksums, which the decoder verifies.)
    pub fn check_whole(&mut self, path: &Path) -> Result<bool, CaptureError> {
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
    pub fn decode(&self, path: &Path) -> Result<DynamicImage, CaptureError> {
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

/// Width and height of a photo, from the head of its file; `None` if it cannot be read.
pub(super) fn size_of(path: &Path) -> Option<[u32; 2]> {
    size_or_error(path).ok()
}

/// Width and height of a photo, from the head of its file.
pub(super) fn size_or_error(path: &Path) -> Result<[u32; 2], CaptureError> {
    let io_error = |source| CaptureError::Io {
        path: path.to_path_buf(),
        source,
    };
    // The contents tell the format, not the name.
    let reader = ImageReader::open(path).map_err(io_error)?;
    let reader = reader.with_guessed_format().map_err(io_error)?;
    let size = reader.into_dimensions();
    size.map(<[u32; 2]>::from)
        .map_err(|error| undecodable(path, &error))
}

/// 8-bit RGB; and alpha, if any pixel is not opaque. Values of 16 bits are rounded to the nearest.
pub(super) fn rgb_and_alpha(photo: DynamicImage) -> (Vec<u8>, Option<Vec<u8>>) {
    if !photo.color().has_alpha() {
        return (photo.into_rgb8().into_raw(), None);
    }
    let rgba = photo.into_rgba8();
    let alpha: Vec<u8> = rgba.pixels().map(|pixel| pixel.0[3]).collect();
    let color = |pixel: &image::Rgba<u8>| [pixel.0[0], pixel.0[1], pixel.0[2]];
    let pixels = rgba.pixels().flat_map(color).collect();
    (pixels, alpha.iter().any(|&a| a != 255).then_some(alpha))
}
