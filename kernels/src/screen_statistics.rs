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
use splat_core::{PROJECTED_EXTENT, PROJECTED_WIDTH, RowGroups};

use crate::bytes::{Bytes, Sizes};
use crate::launch::{Buffer, per_element};
use crate::math::is_finite;
use crate::row_groups::row_of;

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
    groups: &[u32],
    lengths_out: &mut [f32],
    views_out: &mut [f32],
    half_width: f32,
    half_height: f32,
    gaussians: u32,
    cameras: u32,
    gradient_width: u32,
    group: u32,
    #[comptime] grouped: bool,
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
        let mut row = gaussian;
        if comptime!(grouped) {
            row = row_of(groups, gaussian, group as usize);
        }
        lengths_out[row] = lengths[row] + sum;
        views_out[row] = views[row] + count;
    }
}

/// Adds the lengths of `half * gradient`, and the views, to sums of both, `[N]`: in their own
/// memory, where nothing else holds it. Gradients are of packed splats `[C, N, 9]` or of screen
/// means `[C, N, 2]`; the packed splats say which views see a Gaussian. With `rows`, splats are
/// those of these rows alone.
pub fn screen_statistics(
    client: &Client,
    [gradient, packed]: [&Buffer; 2],
    sums: [Buffer; 2],
    half: [f32; 2],
    rows: Option<&RowGroups>,
) -> [Buffer; 2] {
    let [lengths, views] = sums;
    let count = lengths.len().min(views.len());
    let rows = rows.filter(|rows| rows.count() <= count);
    let gaussians = rows.map_or(count, RowGroups::len);
    let cameras = packed.len() / (PROJECTED_WIDTH * gaussians.max(1));
    let gradient_width = gradient.len() / (cameras * gaussians).max(1);
    // Rows that get nothing would be missing from a result in other memory.
    let whole = |sums: Buffer| match rows {
        Some(_) => sums.owned(client),
        None => sums,
    };
    let groups = Buffer::from_u32(client, rows.map_or(&[][..], RowGroups::chosen));
    let (lengths, [lengths_in, lengths_out]) = whole(lengths).overwritten(client, 2);
    let (views, [views_in, views_out]) = whole(views).overwritten(client, 3);
    if let Some((count, dim)) = per_element(gaussians) {
        add_screen_statistics::launch(
            client,
            count,
            dim,
            gradient.arg(),
            packed.arg(),
            lengths_in,
            views_in,
            groups.arg(),
            lengths_out,
            views_out,
            half[0],
            half[1],
            gaussians as u32,
            cameras as u32,
            gradient_width as u32,
            rows.map_or(1, |rows| rows.size() as u32),
            rows.is_some(),
        );
    }
    [lengths, views]
}
