//! Lossless WebP images of codes, one pixel for each Gaussian.

use std::io::Cursor;
use std::path::Path;

use image_webp::{ColorType, EncoderParams, EncodingError, WebPDecoder, WebPEncoder};

use super::super::SceneFileError;
use crate::text::one_line;

/// Longest side of a WebP image.
const LONGEST: u32 = 16_383;

/// Size of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Grid {
    pub width: u32,
    pub height: u32,
}

impl Grid {
    /// The size of the images of so many Gaussians: nearly a square, with sides that are multiples
    /// of 4. `None` if that is too large.
    pub fn of_count(count: usize) -> Option<Self> {
        let width = 4 * ((count as f64).sqrt() / 4.0).ceil().max(1.0) as usize;
        let height = 4 * count.div_ceil(width).div_ceil(4).max(1);
        let side = |side: usize| u32::try_from(side).ok().filter(|side| *side <= LONGEST);
        Some(Self {
            width: side(width)?,
            height: side(height)?,
        })
    }

    fn pixels(self) -> usize {
        self.width as usize * self.height as usize
    }
}

/// An image of pixels of 3 or 4 channels; pixels after them are 0.
pub(super) fn encode<const CHANNELS: usize>(
    path: &Path,
    field: &'static str,
    grid: Grid,
    pixels: &[[u8; CHANNELS]],
) -> Result<Vec<u8>, SceneFileError> {
    let color = if CHANNELS == 4 {
        ColorType::Rgba8
    } else {
        ColorType::Rgb8
    };
    let mut bytes = pixels.as_flattened().to_vec();
    bytes.resize(grid.pixels() * CHANNELS, 0);
    let encode = |use_predictor_transform| -> Result<Vec<u8>, EncodingError> {
        let mut file = Vec::new();
        let mut encoder = WebPEncoder::new(&mut file);
        let mut params = EncoderParams::default();
        params.use_predictor_transform = use_predictor_transform;
        encoder.set_params(params);
        encoder.encode(&bytes, grid.width, grid.height, color)?;
        Ok(file)
    };
    // Prediction helps where neighbours are alike, and hurts labels.
    let both = rayon::join(|| encode(true), || encode(false));
    let smaller = |a: Vec<u8>, b: Vec<u8>| if a.len() <= b.len() { a } else { b };
    match both {
        (Ok(a), Ok(b)) => Ok(smaller(a, b)),
        (Err(error), _) | (_, Err(error)) => Err(SceneFileError::Field {
            path: path.to_path_buf(),
            field,
            reason: format!("WebP: {}", one_line(&error.to_string())),
        }),
    }
}

/// Pixels of an image with one for each of `count` Gaussians.
pub(super) fn decode_gaussians(
    path: &Path,
    field: &'static str,
    file: &[u8],
    count: usize,
) -> Result<Vec<[u8; 4]>, SceneFileError> {
    // Twice as many as there are Gaussians, and some for writers that have a least size.
    let most = count.saturating_mul(2).saturating_add(1 << 16);
    let fits = |grid: Grid| (count..=most).contains(&grid.pixels());
    let expected = format!("{count} Gaussians");
    let (_, mut pixels) = decode(path, field, file, fits, &expected)?;
    pixels.truncate(count);
    Ok(pixels)
}

/// An image, if its size `fits` what is `expected`.
pub(super) fn decode(
    path: &Path,
    field: &'static str,
    file: &[u8],
    fits: impl Fn(Grid) -> bool,
    expected: &str,
) -> Result<(Grid, Vec<[u8; 4]>), SceneFileError> {
    let bad = |reason: &str| SceneFileError::Field {
        path: path.to_path_buf(),
        field,
        reason: format!("WebP: {}", one_line(reason)),
    };
    let webp = |error: image_webp::DecodingError| bad(&error.to_string());
    let mut decoder = WebPDecoder::new(Cursor::new(file)).map_err(webp)?;
    let (width, height) = decoder.dimensions();
    let grid = Grid { width, height };
    if !fits(grid) {
        return Err(bad(&format!(
            "{width} x {height} pixels do not fit {expected}; the file is damaged"
        )));
    }
    if decoder.is_animated() {
        return Err(bad("an animation instead of an image"));
    }
    if decoder.is_lossy() {
        return Err(bad(
            "lossy, which scrambles the codes; write the scene again with lossless images",
        ));
    }
    let channels = if decoder.has_alpha() { 4 } else { 3 };
    let mut bytes = vec![0; grid.pixels() * channels];
    decoder.read_image(&mut bytes).map_err(webp)?;
    let pixels = match channels {
        4 => bytes.as_chunks::<4>().0.to_vec(),
        _ => {
            let rgb = bytes.as_chunks::<3>().0.iter();
            rgb.map(|[r, g, b]| [*r, *g, *b, 255]).collect()
        }
    };
    Ok((grid, pixels))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_are_nearly_square() {
        for (count, expected) in [
            (1, Some((4, 4))),
            (16, Some((4, 4))),
            (17, Some((8, 4))),
            (1_000_000, Some((1_000, 1_000))),
            (400_000_000, None),
        ] {
            let grid = Grid::of_count(count).map(|grid| (grid.width, grid.height));
            assert_eq!(grid, expected, "{count}");
        }
        for count in (1..5_000).step_by(7) {
            let grid = Grid::of_count(count).unwrap();
            assert!(grid.pixels() >= count && grid.width.is_multiple_of(4));
        }
    }
}
