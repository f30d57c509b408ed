//! Sums that density control keeps of every Gaussian (3DGS section 5.2): lengths of the gradients
//! of its screen mean, and views that saw it.
//!
//! A gradient whose length is not finite counts as zero, so that it does not hide the other views.
//! One unit adds all cameras of one Gaussian, in order.
//!
//! Gradients and extents are read out of the rows of packed splats, where they lie.
//!
//! Floor per Gaussian: 8 bytes read and 8 written, and 12 read and 6 operations for every camera.

use cubecl::prelude::*;
use splat_core::{PROJECTED_EXTENT, PROJECTED_WIDTH};

use crate::bytes::{Bytes, Sizes};
use crate::launch::{Buffer, per_element};
use crate::math::is_finite;

/// Floor of the sums of one camera.
pub(crate) fn floor(sizes: &Sizes) -> Bytes {
    Bytes {
        read: 20 * sizes.gaussians,
        written: 8 * sizes.gaussians,
    }
}

#[cube(launch)]
fn add_screen_statistics(
    gradient: &[f32],
    packed: &[f32],
    lengths: &[f32],
    views: &[f32],
    lengths_out: &mut [f32],
    views_out: &mut [f32],
    half_width: f32,
    half_height: f32,
    gaussians: u32,
    cameras: u32,
    gradient_width: u32,
) {
    let gaussians = gaussians as usize;
    let gaussian = ABSOLUTE_POS;
    if gaussian < gaussians {
        let mut sum = 0.0f32;
        let mut count = 0.0f32;
        for camera in 0..cameras as usize {
            let splat = camera * gaussians + gaussian;
            if packed[splat * PROJECTED_WIDTH + PROJECTED_EXTENT] > 0.0f32 {
                let at = splat * gradient_width as usize;
                let x = gradient[at] * half_width;
                let y = gradient[at + 1] * half_height;
                let length = f32::sqrt(x * x + y * y);
                sum += select(is_finite(length), length, 0.0f32);
                count += 1.0f32;
            }
        }
        lengths_out[gaussian] = lengths[gaussian] + sum;
        views_out[gaussian] = views[gaussian] + count;
    }
}

/// Adds the lengths of `half * gradient`, and the views, to sums of both, `[N]`: in their own
/// memory, where nothing else holds it. Gradients are of packed splats `[C, N, 9]` or of screen
/// means `[C, N, 2]`; the packed splats say which views see a Gaussian.
pub fn screen_statistics(
    client: &Client,
    [gradient, packed]: [&Buffer; 2],
    sums: [Buffer; 2],
    half: [f32; 2],
) -> [Buffer; 2] {
    let [lengths, views] = sums;
    let gaussians = lengths.len().min(views.len());
    let cameras = packed.len() / (PROJECTED_WIDTH * gaussians.max(1));
    let gradient_width = gradient.len() / (cameras * gaussians).max(1);
    let (lengths, [lengths_in, lengths_out]) = lengths.overwritten(client, 2);
    let (views, [views_in, views_out]) = views.overwritten(client, 3);
    if let Some((count, dim)) = per_element(gaussians) {
        add_screen_statistics::launch(
            client,
            count,
            dim,
            gradient.arg(),
            packed.arg(),
            lengths_in,
            views_in,
            lengths_out,
            views_out,
            half[0],
            half[1],
            gaussians as u32,
            cameras as u32,
            gradient_width as u32,
        );
    }
    [lengths, views]
}
