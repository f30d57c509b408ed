//! Separable symmetric window over images [B, H, W, D], zero-padded: the local means of SSIM.
//!
//! ```text
//! out(i) = Σ_k window_k in(i + k - (len - 1)/2)      along x, then along y
//! ```
//! The window is symmetric, so the operator is self-adjoint: the same function blurs the gradient.
//!
//! Floor per value: 8 bytes read and 8 written in two passes; 2 operations per pass and tap.

use cubecl::prelude::*;

use crate::launch::{Buffer, per_element};

/// One pass along an axis of `size` entries that lie `stride` elements apart.
#[cube(launch)]
fn blur_axis(
    input: &[f32],
    window: &[f32],
    output: &mut [f32],
    len: u32,
    size: u32,
    stride: u32,
    taps: u32,
) {
    let index = ABSOLUTE_POS as u32;
    if index < len {
        let along = index / stride % size;
        let radius = taps / 2;
        let mut sum = 0.0f32;
        for k in 0..taps {
            // Positions are shifted by the radius to stay unsigned.
            let shifted = along + k;
            if shifted >= radius && shifted - radius < size {
                let at = index + k * stride - radius * stride;
                sum += window[k as usize] * input[at as usize];
            }
        }
        output[index as usize] = sum;
    }
}

/// Blurs `image` [B, `height`, `width`, `channels`] with an odd, symmetric `window`.
pub fn blur(
    client: &Client,
    image: &Buffer,
    height: usize,
    width: usize,
    channels: usize,
    window: &[f32],
) -> Buffer {
    let taps = window.len() as u32;
    let window = Buffer::from_f32(client, window);
    let pass = |input: &Buffer, size: usize, stride: usize| {
        let output = Buffer::empty(client, input.len());
        if let Some((count, dim)) = per_element(input.len()) {
            blur_axis::launch(
                client,
                count,
                dim,
                input.arg(),
                window.arg(),
                output.arg(),
                input.len() as u32,
                size as u32,
                stride as u32,
                taps,
            );
        }
        output
    };
    let along_x = pass(image, width, channels);
    pass(&along_x, height, width * channels)
}
