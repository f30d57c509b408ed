//! Memory and work of the rasteriser, in numbers and words.

use cubecl::prelude::*;

use super::slots::SHAPE_GRADIENTS;
use super::tile::Plan;
use super::{RasterizeInputs, RasterizeSettings, RasterizeState, Sums, blend};
use crate::intersect::Frames;

/// Bytes that a forward pass leaves on the device until its gradient is made.
#[derive(Clone, Copy, Debug)]
pub struct Kept;

impl Kept {
    /// Where the list begins and ends.
    pub const PER_TILE: u64 = 8;
    /// Transmittance, and number of splats walked. The image has four bytes per channel and for
    /// alpha.
    pub const PER_PIXEL: u64 = 8;

    /// For sums in order: place in the order of depth, and where the slots begin, twice: by splat
    /// and by place.
    pub const fn per_splat(sums: Sums) -> u64 {
        match sums {
            Sums::Ordered => 12,
            Sums::Atomic | Sums::Exchange => 0,
        }
    }

    /// Splat, and for sums in order the slot, of all intersections that there was room for: up to a
    /// quarter more than there are.
    pub const fn per_intersection(sums: Sums) -> u64 {
        match sums {
            Sums::Ordered => 8,
            Sums::Atomic | Sums::Exchange => 4,
        }
    }

    /// Bytes per intersection that the gradient takes while it is made.
    pub const fn gradient_per_intersection(channels: u64, sums: Sums) -> u64 {
        match sums {
            Sums::Ordered => 4 * (SHAPE_GRADIENTS as u64 + channels),
            Sums::Atomic | Sums::Exchange => 0,
        }
    }
}

/// How this device's tiles are dealt out, in words.
pub fn variant(client: &Client) -> String {
    let plan = Plan::new(client);
    let (side, lanes) = (plan.side(), plan.lanes());
    let owner = match lanes {
        1 => "one unit each, no planes".to_owned(),
        lanes => format!("a plane of {lanes} each"),
    };
    format!(
        "{} blocks of {side} x {side} pixels, {owner}; up to {} channels a launch",
        plan.blocks(),
        plan.channels()
    )
}

/// How [`Sums::Atomic`] is done on this device, in words.
pub fn unordered(client: &Client) -> &'static str {
    match Sums::Atomic.unordered(client) {
        Sums::Exchange => "atomic exchanges",
        _ => "atomic additions of floats",
    }
}

/// (Pixel, splat) pairs of a forward pass.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Evaluations {
    /// Pairs whose alpha was computed for a pixel that was still open: the splats of its tile whose
    /// ellipse meets its block.
    pub tested: u64,
    /// Those of them past the alpha cut: blended, or the one that would leave too little light.
    pub seen: u64,
    /// Those that changed a pixel.
    pub blended: u64,
}

/// Counts the evaluations of [`rasterize`](super::rasterize) by rendering once more; a measurement,
/// which waits for the device.
///
/// # Errors
/// The device's error, in words.
pub fn count_evaluations(
    client: &Client,
    inputs: &RasterizeInputs,
    state: &RasterizeState,
    frames: &Frames,
    settings: &RasterizeSettings,
) -> Result<Evaluations, String> {
    let [output, tested, blended] = blend(client, inputs, &state.lists, frames, settings, true);
    let output = output.read_f32(client)?;
    let seen = output.chunks_exact(inputs.channels + 1);
    let seen = seen.map(|pixel| pixel[inputs.channels] as u64).sum();
    let tested = tested.read_f32(client)?;
    let blended = blended.read_u32(client)?;
    Ok(Evaluations {
        tested: tested.into_iter().map(|count| count as u64).sum(),
        seen,
        blended: blended.into_iter().map(u64::from).sum(),
    })
}
