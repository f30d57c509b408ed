//! Downscaling by an integer factor: the mean over blocks of `factor` x `factor` pixels.

/// An 8-bit RGB image, row by row, and which of its pixels count.
pub(super) struct Picture<'a> {
    pub pixels: &'a [u8],
    pub mask: Option<&'a [u8]>,
    pub width: u32,
    pub height: u32,
}

/// Area-averages a picture by `factor`, to `floor(width / factor)` x `floor(height / factor)`.
/// Remaining pixels at the right and bottom edge are dropped.
///
/// The average is taken over 8-bit values without gamma, and rounded to nearest. This is the usual
/// resampling of the field, on which published scores at reduced size are based. With pixel centres
/// at + 0.5 the intrinsics are divided by `factor`, see [`intrinsics`].
///
/// The mask is averaged likewise: a pixel counts by the share of its block that does. Its colour is
/// the mean weighted by the mask, so that ignored colours do not bleed into it; where the whole
/// block is ignored, it is the plain mean.
pub(super) fn area_average(picture: &Picture<'_>, factor: u32) -> (Vec<u8>, Option<Vec<u8>>) {
    let (w, k) = (picture.width as usize, factor as usize);
    let out_width = (picture.width / factor) as usize;
    let out_height = (picture.height / factor) as usize;
    let mut pixels = Vec::with_capacity(3 * out_width * out_height);
    let mut mask = picture
        .mask
        .map(|_| Vec::with_capacity(out_width * out_height));
    for y in 0..out_height {
        for x in 0..out_width {
            let rows = (y * k..(y + 1) * k).map(|row| row * w + x * k);
            let weight = match (picture.mask, &mut mask) {
                (Some(values), Some(out)) => {
                    let rows = rows.clone().flat_map(|start| &values[start..start + k]);
                    let weight: u64 = rows.map(|&value| u64::from(value)).sum();
                    out.push(rounded(weight, (factor as u64).pow(2)));
                    weight
                }
                _ => 0,
            };
            let weights = picture.mask.filter(|_| weight > 0);
            // A sum over 2^32 pixels of 255 times 255 fits into 64 bits.
            let (mut sum, mut area) = ([0u64; 3], 0);
            for start in rows {
                for at in start..start + k {
                    let weight = weights.map_or(1, |weights| u64::from(weights[at]));
                    area += weight;
                    for (sum, &value) in sum.iter_mut().zip(&picture.pixels[3 * at..3 * at + 3]) {
                        *sum += weight * u64::from(value);
                    }
                }
            }
            pixels.extend(sum.map(|sum| rounded(sum, area)));
        }
    }
    (pixels, mask)
}

fn rounded(sum: u64, count: u64) -> u8 {
    ((sum + count / 2) / count) as u8
}

/// Intrinsics `[fx, fy, cx, cy]` after [`area_average`] by `factor`.
pub(super) fn intrinsics(original: [f64; 4], factor: u32) -> [f64; 4] {
    original.map(|value| value / f64::from(factor))
}
