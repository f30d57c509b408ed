//! Blending of the tiles, front to back, and its vector-Jacobian product (3DGS section 6 and
//! appendix C).
//!
//! Per pixel, over the splats i of its tile in depth order, d = pixel centre - mean:
//! ```text
//! z1 = w11 dx, z2 = w21 dx + w22 dy, sigma = (z1² + z2²)/2, raw = o exp(-sigma)
//! skip if raw < alpha_min;  alpha = min(alpha_max, raw);  stop before T (1 - alpha) < transmittance_min
//! image += T alpha colour;  T *= 1 - alpha;     at the end  image += T background;  A = 1 - T
//! ```
//! Backward goes back to front and recovers T by division. With g the pixel's gradient (g_A for A)
//! and `behind = T_end (background · g - g_A) + Σ of T alpha (colour · g) over the splats behind`:
//! ```text
//! dL/dcolour = T alpha g,   dL/dalpha = T (colour · g) - behind / (1 - alpha)     (0 at the cap)
//! ```
//! Gradients of one intersection are summed over the tile's pixels in fixed order. By default each
//! writes to its own slot, and then the slots of every splat are summed in order: the same bits
//! every time. [`Sums`] has the other way, without slots.
//!
//! Any number of channels: those beyond what one launch can do (at most [`MAX_CHANNELS`]) go in
//! further ones.

mod background;
mod backward;
mod forward;
mod measure;
mod pair;
mod slots;
mod sums;
mod tile;
mod vjp;

use cubecl::prelude::*;
use splat_core::PROJECTED_WIDTH;

use self::forward::rasterize_forward;
pub use self::measure::{Evaluations, Kept, count_evaluations, unordered, variant};
use self::pair::thresholds;
use self::slots::SHAPE_GRADIENTS;
pub use self::sums::Sums;
use self::tile::Plan;
pub use self::vjp::rasterize_vjp;
use crate::bytes::{Bytes, Sizes};
use crate::intersect::{Frames, IntersectError, MAX_SLOT_VALUES, TileLists, intersect_ahead};
use crate::launch::{Buffer, cube_count, per_element};
use crate::math::is_finite;

/// Most channels of one launch; fewer where a unit has many pixels.
pub const MAX_CHANNELS: usize = 32;

/// Half of the channels of a launch, and the shape, are what the lists leave room for.
const _: () = assert!(MAX_SLOT_VALUES == SHAPE_GRADIENTS + MAX_CHANNELS / 2);

/// Thresholds of the blending, and how its gradients are summed.
#[derive(Clone, Copy, Debug)]
pub struct RasterizeSettings {
    /// Cap of alpha.
    pub alpha_max: f32,
    /// A pixel stops before its transmittance falls below this.
    pub transmittance_min: f32,
    /// How gradients of one splat from many tiles are summed.
    pub sums: Sums,
}

impl From<&splat_core::RasterizeSettings> for RasterizeSettings {
    fn from(settings: &splat_core::RasterizeSettings) -> Self {
        Self {
            alpha_max: settings.alpha_max as f32,
            transmittance_min: settings.transmittance_min as f32,
            sums: if settings.deterministic {
                Sums::Ordered
            } else {
                Sums::Atomic
            },
        }
    }
}

/// State that a forward pass leaves for its backward pass.
#[derive(Clone, Debug)]
pub struct RasterizeState {
    /// The tiles' lists; without slots where the forward pass was to expect no sums in order.
    pub lists: TileLists,
    /// Transmittance that is left of every pixel [C, H, W].
    pub transmittance: Buffer,
    /// How many splats of its tile's list every pixel has walked, the last one that contributed
    /// included [C, H, W].
    pub walked: Buffer,
}

/// Splats, and what colours them: `packed` [C, N, 9], `colors` [C, N, D], `opacities` [C, N],
/// `background` [C, D].
#[derive(Clone, Debug)]
pub struct RasterizeInputs {
    /// Packed splats of [`crate::project`].
    pub packed: Buffer,
    /// Colours, any number of channels.
    pub colors: Buffer,
    /// Opacities.
    pub opacities: Buffer,
    /// Colour behind all splats; zero if there is none.
    pub background: Option<Buffer>,
    /// D.
    pub channels: usize,
}

/// The opacity of every splat, zero where a colour is not finite: it is then in no list, and
/// nothing reads it.
#[cube(launch)]
fn hide_broken_colors(
    colors: &[f32],
    opacities: &[f32],
    out: &mut [f32],
    splats: u32,
    channels: u32,
) {
    let splat = ABSOLUTE_POS;
    if splat < splats as usize {
        let mut opacity = opacities[splat];
        for channel in 0..channels as usize {
            if !is_finite(colors[splat * channels as usize + channel]) {
                opacity = 0.0f32;
            }
        }
        out[splat] = opacity;
    }
}

fn without_broken_colors(client: &Client, inputs: &RasterizeInputs, frames: &Frames) -> Buffer {
    let out = Buffer::empty(client, frames.splats());
    if let Some((count, dim)) = per_element(frames.splats()) {
        hide_broken_colors::launch(
            client,
            count,
            dim,
            inputs.colors.arg(),
            inputs.opacities.arg(),
            out.arg(),
            frames.splats() as u32,
            inputs.channels as u32,
        );
    }
    out
}

/// Renders all cameras: the image with alpha as its last channel [C, H, W, D + 1], and what the
/// backward pass needs. Waits once until the number of intersections is known, while the device
/// goes on.
///
/// # Errors
/// Those of [`crate::intersect::intersect`].
pub fn rasterize(
    client: &Client,
    inputs: &RasterizeInputs,
    frames: &Frames,
    settings: &RasterizeSettings,
) -> Result<(Buffer, RasterizeState), IntersectError> {
    let opacities = without_broken_colors(client, inputs, frames);
    let (mut lists, blended) =
        intersect_ahead(client, &inputs.packed, &opacities, frames, |lists| {
            blend(client, inputs, lists, frames, settings, false)
        })?;
    let [output, transmittance, walked] = blended;
    if settings.sums != Sums::Ordered {
        lists.slots = None;
    }
    let state = RasterizeState {
        lists,
        transmittance,
        walked,
    };
    Ok((output, state))
}

/// Renders with lists that are there already: the image, and of every pixel the transmittance that
/// is left and how many splats it has walked. `counting`: see [`rasterize_forward`].
fn blend(
    client: &Client,
    inputs: &RasterizeInputs,
    lists: &TileLists,
    frames: &Frames,
    settings: &RasterizeSettings,
    counting: bool,
) -> [Buffer; 3] {
    let plan = Plan::new(client);
    let pixels = frames.cameras * frames.width as usize * frames.height as usize;
    let output = Buffer::empty(client, pixels * (inputs.channels + 1));
    let transmittance = Buffer::empty(client, pixels);
    let walked = Buffer::empty(client, pixels);
    for first_channel in (0..inputs.channels).step_by(plan.channels()) {
        rasterize_forward::launch(
            client,
            cube_count(frames.tiles()),
            plan.cube_dim(),
            inputs.packed.arg(),
            inputs.colors.arg(),
            inputs.opacities.arg(),
            inputs.background.as_ref().map(Buffer::arg).into(),
            lists.splats.arg(),
            lists.ranges.arg(),
            output.arg(),
            transmittance.arg(),
            walked.arg(),
            frames.uniforms(),
            thresholds(frames, settings),
            inputs.channels as u32,
            first_channel as u32,
            plan,
            plan.channels().min(inputs.channels - first_channel),
            first_channel == 0,
            counting,
        );
    }
    [output, transmittance, walked]
}

/// Floors of forward and gradient for one camera, with lists that are there; the gradient summed in
/// order.
pub(crate) fn floor(sizes: &Sizes) -> [Bytes; 2] {
    let (i, pixels, color) = (sizes.intersections, sizes.pixels(), 4 * sizes.channels);
    // In the gradient: its sums per intersection, written and read again, and what becomes of them
    // per Gaussian.
    let sums = (24 + color) * i;
    let packed_and_opacity = 4 * (PROJECTED_WIDTH as u64 + 1);
    [
        Bytes {
            read: (28 + color) * i,
            written: (12 + color) * pixels,
        },
        Bytes {
            read: (32 + color) * i + (12 + color) * pixels + sums,
            written: sums + (packed_and_opacity + color) * sizes.gaussians,
        },
    ]
}
