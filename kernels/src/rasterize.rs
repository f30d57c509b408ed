//! Blending of the tiles, front to back, and its vector-Jacobian product (3DGS section 6 and appendix C).
//!
//! Per pixel, over the splats i of its tile in depth order, d = pixel centre - mean:
//! ```text
//! z1 = w11 dx, z2 = w21 dx + w22 dy, sigma = (z1² + z2²)/2, raw = o exp(-sigma)
//! skip if raw < alpha_min;  alpha = min(alpha_max, raw);  stop before T (1 - alpha) < transmittance_min
//! image += T alpha colour;  T *= 1 - alpha;     at the end  image += T background;  A = 1 - T
//! ```
//! Backward goes back to front and recovers T by division. With g the pixel's gradient (g_A for A) and
//! `behind = T_end (background · g - g_A) + Σ of T alpha (colour · g) over the splats behind`:
//! ```text
//! dL/dcolour = T alpha g,   dL/dalpha = T (colour · g) - behind / (1 - alpha)     (0 at the cap)
//! ```
//! Gradients of one (tile, splat) pair are summed over the tile's pixels in fixed order. By default each pair writes to
//! its own slot, and then the slots of every splat are summed in order: the same bits every time. [`Sums`] has the other
//! way, without slots.
//!
//! Any number of channels: those beyond what one launch can do (at most [`MAX_CHANNELS`]) go in further ones.

mod background;
mod backward;
mod forward;
mod pair;
mod sums;
mod tile;

use cubecl::prelude::*;
use splat_core::{PROJECTED_WIDTH, RasterizeTensors};

use self::background::background_gradient;
use self::backward::{SHAPE_GRADIENTS, SlotLayout, rasterize_backward};
use self::forward::rasterize_forward;
use self::pair::thresholds;
pub use self::sums::Sums;
use self::sums::{SlotTargetLaunch, SplatTargetLaunch, TargetArgs, sum_slots};
use self::tile::Plan;
use crate::floor::{Bytes, Sizes};
use crate::intersect::{Frames, IntersectError, Slots, TileLists, intersect_ahead};
use crate::launch::{Buffer, cube_count, per_element};
use crate::math::is_finite;

/// Most channels of one launch; fewer where a unit has many pixels.
pub const MAX_CHANNELS: usize = 32;

/// Gradients of one instance that a 32-bit index reaches however many instances there are; more of them only of fewer.
pub const MAX_SLOT_VALUES: usize = SHAPE_GRADIENTS + MAX_CHANNELS / 2;

/// Most channels of one launch of the backward pass, of `most` that it could do: the slots of all instances must fit into
/// a buffer of `bytes`, and within reach of an index.
fn slot_channels(most: usize, bytes: u64, instances: usize) -> usize {
    let floats = (bytes / 4).min(u64::from(u32::MAX));
    let values = (floats / instances.max(1) as u64) as usize;
    values.saturating_sub(SHAPE_GRADIENTS).clamp(1, most)
}

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

/// What a forward pass leaves for its backward pass.
#[derive(Clone, Debug)]
pub struct RasterizeState {
    /// The tiles' lists; without slots where the forward pass was to expect no sums in order.
    pub lists: TileLists,
    /// Transmittance that is left of every pixel [C, H, W].
    pub transmittance: Buffer,
    /// How many splats of its tile's list every pixel has walked, the last one that contributed included [C, H, W].
    pub walked: Buffer,
}

/// Splats, and what colours them: `packed` [C, N, 9], `colors` [C, N, D], `opacities` [C, N], `background` [C, D].
#[derive(Clone, Debug)]
pub struct RasterizeInputs {
    /// Packed splats of [`crate::project`].
    pub packed: Buffer,
    /// Colours, any number of channels.
    pub colors: Buffer,
    /// Opacities.
    pub opacities: Buffer,
    /// What is behind all splats; zero if there is none.
    pub background: Option<Buffer>,
    /// D.
    pub channels: usize,
}

/// The opacity of every splat, zero where a colour is not finite: it is then in no list, and nothing reads it.
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

/// Renders all cameras: the image with alpha as its last channel [C, H, W, D + 1], and what the backward pass needs.
/// Waits once until the
/// number of instances is known, while the device goes on.
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

/// Renders with lists that are there already: the image, and of every pixel the transmittance that is left and how many
/// splats it has walked. `counting`: see [`rasterize_forward`].
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

/// What forward and gradient must move for one camera, with lists that are there; the gradient summed in order.
pub(crate) fn floor(sizes: &Sizes) -> [Bytes; 2] {
    let (i, pixels, color) = (sizes.instances, sizes.pixels(), 4 * sizes.channels);
    // In the gradient: its sums per instance, written and read again, and what becomes of them per Gaussian.
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

/// Bytes that a forward pass leaves on the device until its gradient is made.
#[derive(Clone, Copy, Debug)]
pub struct Kept;

impl Kept {
    /// Where the list begins and ends.
    pub const PER_TILE: u64 = 8;
    /// What is left of the light, and how many splats were walked. The image has four bytes per channel and for alpha.
    pub const PER_PIXEL: u64 = 8;

    /// For sums in order: place in the order of depth, and where the slots begin, twice: by splat and by place.
    pub const fn per_splat(sums: Sums) -> u64 {
        match sums {
            Sums::Ordered => 12,
            Sums::Atomic | Sums::Exchange => 0,
        }
    }

    /// Splat, and for sums in order the slot, of all instances that there was room for: up to a quarter more than there
    /// are.
    pub const fn per_instance(sums: Sums) -> u64 {
        match sums {
            Sums::Ordered => 8,
            Sums::Atomic | Sums::Exchange => 4,
        }
    }

    /// Bytes per instance that the gradient takes while it is made.
    pub const fn gradient_per_instance(channels: u64, sums: Sums) -> u64 {
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

/// What [`Sums::Atomic`] is on this device, in words.
pub fn unordered(client: &Client) -> &'static str {
    match Sums::Atomic.unordered(client) {
        Sums::Exchange => "atomic exchanges",
        _ => "atomic additions of floats",
    }
}

/// (Pixel, splat) pairs of a forward pass.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Evaluations {
    /// Pairs whose alpha was computed for a pixel that was still open: the splats of its tile whose ellipse meets its
    /// block.
    pub tested: u64,
    /// Those of them past the alpha cut: blended, or the one that would leave too little light.
    pub seen: u64,
    /// Those that changed a pixel.
    pub blended: u64,
}

/// Counts the evaluations of [`rasterize`] by rendering once more; a measurement, which waits for the device.
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

#[cube(launch)]
fn fill_zero(buffer: &mut [f32], len: u32) {
    if ABSOLUTE_POS < len as usize {
        buffer[ABSOLUTE_POS] = 0.0f32;
    }
}

fn zeros(client: &Client, len: usize) -> Buffer {
    let buffer = Buffer::empty(client, len);
    if let Some((count, dim)) = per_element(len) {
        fill_zero::launch(client, count, dim, buffer.arg(), len as u32);
    }
    buffer
}

/// Gradients of packed splats [C, N, 9], colours [C, N, D], opacities [C, N] and background [C, D] for the gradient of
/// the output [C, H, W, D + 1]; only those that `needs_grad` names. In order if `state` has slots.
pub fn rasterize_vjp(
    client: &Client,
    inputs: &RasterizeInputs,
    state: &RasterizeState,
    grad_output: &Buffer,
    frames: &Frames,
    settings: &RasterizeSettings,
    needs_grad: RasterizeTensors<bool>,
) -> RasterizeTensors<Option<Buffer>> {
    let splats = frames.splats();
    let channels = inputs.channels;
    let shape = needs_grad.packed || needs_grad.opacities;
    let lists = &state.lists;
    let sums = match lists.slots {
        Some(_) => Sums::Ordered,
        None => settings.sums.unordered(client),
    };
    let reserve = |needed: bool, len: usize| match sums {
        _ if !needed => Buffer::empty(client, 1),
        // Every element is written.
        Sums::Ordered => Buffer::empty(client, len),
        Sums::Atomic | Sums::Exchange => zeros(client, len),
    };
    let gradients = [
        reserve(shape, splats * PROJECTED_WIDTH),
        reserve(needs_grad.colors, splats * channels),
        reserve(shape, splats),
    ];

    if shape || needs_grad.colors {
        let plan = Plan::new(client);
        let page = client.properties().memory.max_page_size;
        let width = match sums {
            Sums::Ordered => slot_channels(plan.channels(), page, lists.instances),
            Sums::Atomic | Sums::Exchange => plan.channels(),
        };
        for first_channel in (0..channels).step_by(width) {
            let layout = SlotLayout {
                shape,
                colors: needs_grad.colors,
                width: width.min(channels - first_channel),
            };
            let launch = Launch {
                client,
                inputs,
                state,
                grad_output,
                frames,
                settings,
                plan,
                layout,
                first_channel,
            };
            match &lists.slots {
                Some(slots) => launch.in_order(slots, &gradients),
                None if sums == Sums::Atomic => launch.as_they_come::<f32>(sums, &gradients),
                None => launch.as_they_come::<u32>(sums, &gradients),
            }
        }
    }
    let [grad_packed, grad_colors, grad_opacities] = gradients;
    RasterizeTensors {
        packed: needs_grad.packed.then_some(grad_packed),
        colors: needs_grad.colors.then_some(grad_colors),
        opacities: needs_grad.opacities.then_some(grad_opacities),
        background: (needs_grad.background && inputs.background.is_some())
            .then(|| background_gradient(client, state, grad_output, channels, frames)),
    }
}

/// Some channels of the backward pass, as many as a launch can do.
struct Launch<'a> {
    client: &'a Client,
    inputs: &'a RasterizeInputs,
    state: &'a RasterizeState,
    grad_output: &'a Buffer,
    frames: &'a Frames,
    settings: &'a RasterizeSettings,
    plan: Plan,
    layout: SlotLayout,
    first_channel: usize,
}

impl Launch<'_> {
    /// To slots, and these to the gradients of packed splats, colours and opacities.
    fn in_order(&self, slots: &Slots, gradients: &[Buffer; 3]) {
        let [grad_packed, grad_colors, grad_opacities] = gradients;
        let splats = self.frames.splats();
        let values = self.layout.values();
        let slot_gradients = zeros(self.client, self.state.lists.instances * values);
        let target = SlotTargetLaunch::new(slots.of.arg(), slot_gradients.arg());
        self.tiles::<u32>(Sums::Ordered, TargetArgs::Slots(target));
        if let Some((count, dim)) = per_element(splats * values) {
            sum_slots::launch(
                self.client,
                count,
                dim,
                slot_gradients.arg(),
                slots.visible.arg(),
                slots.order.arg(),
                slots.offsets.arg(),
                grad_packed.arg(),
                grad_colors.arg(),
                grad_opacities.arg(),
                splats as u32,
                self.inputs.channels as u32,
                self.first_channel as u32,
                self.layout,
                self.first_channel == 0,
            );
        }
    }

    /// Added to the gradients, which are zero before the first launch.
    fn as_they_come<A: Numeric>(&self, sums: Sums, gradients: &[Buffer; 3]) {
        let [packed, colors, opacities] = gradients.each_ref().map(Buffer::arg);
        let target = SplatTargetLaunch::new(packed, colors, opacities);
        self.tiles::<A>(sums, TargetArgs::Splats(target));
    }

    fn tiles<A: Numeric>(&self, sums: Sums, target: TargetArgs<A>) {
        let (inputs, state, frames) = (self.inputs, self.state, self.frames);
        if state.lists.instances == 0 {
            return;
        }
        rasterize_backward::launch::<A>(
            self.client,
            cube_count(frames.tiles()),
            self.plan.cube_dim(),
            inputs.packed.arg(),
            inputs.colors.arg(),
            inputs.opacities.arg(),
            inputs.background.as_ref().map(Buffer::arg).into(),
            state.lists.splats.arg(),
            state.lists.ranges.arg(),
            state.transmittance.arg(),
            state.walked.arg(),
            self.grad_output.arg(),
            target,
            frames.uniforms(),
            thresholds(frames, self.settings),
            inputs.channels as u32,
            self.first_channel as u32,
            self.plan,
            self.layout,
            sums,
            self.first_channel == 0,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::intersect::MAX_INSTANCES;

    #[test]
    fn the_more_instances_the_fewer_channels_at_once() {
        assert_eq!(slot_channels(32, 1 << 40, 0), 32);
        assert_eq!(slot_channels(32, 1 << 40, 1_000_000), 32);
        assert_eq!(slot_channels(32, 1 << 40, MAX_INSTANCES as usize), 16);
        // 128 MiB: 33 floats for each of a million instances, 3 for each of eleven million.
        assert_eq!(slot_channels(32, 1 << 27, 1_000_000), 27);
        assert_eq!(slot_channels(32, 1 << 27, 11_000_000), 1);
        for instances in [1, 1000, 1 << 20, MAX_INSTANCES] {
            let values = SHAPE_GRADIENTS + slot_channels(32, 1 << 40, instances as usize);
            assert!(instances * values as u64 <= u64::from(u32::MAX));
        }
    }
}
