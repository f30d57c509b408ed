//! Downscaling by an integer factor: the mean over blocks of `factor` x `factor` pixels.

/// Area-averages an 8-bit RGB image of `width` x `height` pixels by `factor`, to `floor(width /
/// factor)` x `floor(height / factor)`. Remaining pixels at the right and bottom edge are dropped.
///
/// The average is taken over 8-bit values without gamma, and rounded to nearest. This is the usual
/// resampling of the field, on which published scores at reduced size are based. With pixel centres
/// at + 0.5 the intrinsics are divided by `factor`, see [`intrinsics`].
pub(super) fn area_average(
    image: &[u8],
    width: u32,
    height: u32,
    factor: u32,
) -> (Vec<u8>, u32, u32) {
    let (out_width, out_height) = (width / factor, height / factor);
    let (w, k) = (width as usize, factor as usize);
    // The sum over a block of up to 2^32 pixels of 255 fits into 64 bits.
    let area = (factor as u64).pow(2);
    let mut out = Vec::with_capacity(3 * out_width as usize * out_height as usize);
    for y in 0..out_height as usize {
        for x in 0..out_width as usize {
            let mut sum = [0u64; 3];
            for row in y * k..(y + 1) * k {
                let start = 3 * (row * w + x * k);
                for pixel in image[start..start + 3 * k].chunks_exact(3) {
                    for (sum, &value) in sum.iter_mut().zip(pixel) {
                        *sum += u64::from(value);
                    }
                }
            }
            out.extend(sum.map(|sum| ((sum + area / 2) / area) as u8));
        }
    }
    (out, out_width, out_height)
}

/// Intrinsics `[fx, fy, cx, cy]` after [`area_average`] by `factor`.
pub(super) fn intrinsics(original: [f64; 4], factor: u32) -> [f64; 4] {
    original.map(|value| value / f64::from(factor))
}
