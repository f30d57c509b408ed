//! Pictures: from rendered values to 8-bit RGB, side by side, to PNG.

use std::io::Cursor;
use std::path::Path;

use image::{ImageFormat, RgbImage};

use super::{ReportError, write};

/// Width in pixels of the white gap between two pictures side by side.
const GAP: u32 = 4;

/// An 8-bit RGB picture.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    pixels: RgbImage,
}

impl Picture {
    /// From `[height, width, 3]` values, row by row; clamped to `[0, 1]`, NaN as 0.
    ///
    /// # Errors
    ///
    /// [`ReportError::Shape`] unless there are `3 width height` values.
    pub fn from_rgb_f32(width: u32, height: u32, values: &[f32]) -> Result<Self, ReportError> {
        Self::from_rgb8(width, height, values.iter().map(|&v| to_byte(v)).collect())
    }

    /// From `[height, width]` values such as alpha or a scaled depth; clamped to `[0, 1]`, NaN as
    /// 0.
    ///
    /// # Errors
    ///
    /// [`ReportError::Shape`] unless there are `width height` values.
    pub fn from_gray_f32(width: u32, height: u32, values: &[f32]) -> Result<Self, ReportError> {
        let pixels = values.iter().flat_map(|&v| [to_byte(v); 3]).collect();
        Self::from_rgb8(width, height, pixels)
    }

    /// From `3 width height` bytes, such as those of a photo.
    ///
    /// # Errors
    ///
    /// [`ReportError::Shape`] unless there are `3 width height` bytes.
    pub fn from_rgb8(width: u32, height: u32, bytes: Vec<u8>) -> Result<Self, ReportError> {
        let len = bytes.len();
        let fits = len as u128 == 3 * u128::from(width) * u128::from(height);
        let pixels = fits.then(|| RgbImage::from_raw(width, height, bytes));
        let pixels = pixels.flatten().ok_or_else(|| ReportError::Shape {
            reason: format!("{len} values for {width}x{height} pixels"),
        })?;
        Ok(Self { pixels })
    }

    /// Width in pixels.
    pub fn width(&self) -> u32 {
        self.pixels.width()
    }

    /// Height in pixels.
    pub fn height(&self) -> u32 {
        self.pixels.height()
    }

    /// Puts `right` to the right of this picture, with a white gap, for photo and render.
    ///
    /// # Errors
    ///
    /// [`ReportError::Shape`] if the heights differ.
    pub fn beside(&self, right: &Self) -> Result<Self, ReportError> {
        if self.height() != right.height() {
            return Err(ReportError::Shape {
                reason: format!(
                    "heights {} and {} side by side",
                    self.height(),
                    right.height()
                ),
            });
        }
        let start = self.width() + GAP;
        let pixels = RgbImage::from_fn(start + right.width(), self.height(), |x, y| {
            if x < self.width() {
                *self.pixels.get_pixel(x, y)
            } else if x < start {
                image::Rgb([255; 3])
            } else {
                *right.pixels.get_pixel(x - start, y)
            }
        });
        Ok(Self { pixels })
    }

    /// Writes the picture as PNG.
    ///
    /// # Errors
    ///
    /// [`ReportError`], naming the file.
    pub fn write(&self, path: &Path) -> Result<(), ReportError> {
        let mut encoded = Cursor::new(Vec::new());
        self.pixels
            .write_to(&mut encoded, ImageFormat::Png)
            .map_err(|error| ReportError::Encode {
                path: path.to_path_buf(),
                reason: error.to_string(),
            })?;
        write(path, encoded.get_ref())
    }
}

/// Maps `[0, 1]` to 0..=255, rounded to nearest. The cast saturates and maps NaN to 0.
fn to_byte(value: f32) -> u8 {
    (value * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_rounded_and_clamped() {
        let values = [
            -1.0,
            0.0,
            1.0 / 255.0,
            0.5,
            1.0,
            7.0,
            f32::NAN,
            f32::INFINITY,
        ];
        assert_eq!(values.map(to_byte), [0, 0, 1, 128, 255, 255, 0, 255]);
        // A photo survives the conversion through float.
        for byte in 0..=255u8 {
            assert_eq!(to_byte(f32::from(byte) / 255.0), byte);
        }
    }

    #[test]
    fn truth_stands_beside_the_render() {
        let truth = Picture::from_rgb8(2, 1, vec![1, 2, 3, 4, 5, 6]).unwrap();
        let render = Picture::from_gray_f32(1, 1, &[1.0]).unwrap();
        let both = truth.beside(&render).unwrap();
        assert_eq!((both.width(), both.height()), (2 + GAP + 1, 1));
        let folder = tempfile::TempDir::new().unwrap();
        let path = folder.path().join("views/a.png");
        both.write(&path).unwrap();
        let read = image::open(&path).unwrap().into_rgb8().into_raw();
        assert_eq!(read[..6], [1, 2, 3, 4, 5, 6]);
        assert!(read[6..].iter().all(|&byte| byte == 255));

        assert!(Picture::from_rgb_f32(2, 2, &[0.0; 11]).is_err());
        assert!(Picture::from_rgb8(u32::MAX, u32::MAX, vec![]).is_err());
        let tall = Picture::from_gray_f32(1, 2, &[0.0; 2]).unwrap();
        assert!(truth.beside(&tall).is_err());
    }
}
