//! How the gradients of a splat's tiles become the splat's: in order, or as they come.
//!
//! In order, each intersection writes to its own slot, and then the slots of every splat are
//! summed: the same bits every time. As they come, they are added to the splat's gradient by atomic
//! additions, whose order differs from run to run: no slots, and nothing to be read again.
//!
//! Floor per intersection: in order 24 bytes and 4 per channel to memory, and once more from it; as
//! they come 6 additions and 1 per channel in memory.

use cubecl::client::Client;
use cubecl::features::AtomicUsage;
use cubecl::ir::Type;
use cubecl::prelude::*;
use splat_core::{PROJECTED_EXTENT, PROJECTED_WIDTH};

use super::slots::{ABSOLUTE, SlotLayout};

/// How gradients of one splat from many tiles are summed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Sums {
    /// Every tile's in a slot of its own, then in order: the same bits every time.
    #[default]
    Ordered,
    /// By atomic additions of floats; where the device has none, as [`Sums::Exchange`].
    Atomic,
    /// By atomic exchanges, which every device has.
    Exchange,
}

impl Sums {
    /// The way without an order that this device has.
    pub(super) fn unordered(self, client: &Client) -> Self {
        let float = Type::atomic(f32::elem_type_native());
        let usage = client.properties().atomic_type_usage(float);
        match self {
            Self::Ordered | Self::Atomic if usage.contains(AtomicUsage::Add) => Self::Atomic,
            _ => Self::Exchange,
        }
    }
}

/// Where the sums of a tile go. Only what it names is bound: devices bind few buffers at once.
#[derive(CubeType, CubeLaunch)]
#[allow(dead_code, reason = "the host makes `TargetArgs` of it")]
pub(super) enum Target<A: Numeric> {
    /// To slots, for sums in order.
    Slots(SlotTarget),
    /// To splats at once.
    Splats(SplatTarget<A>),
}

/// The slot of every intersection, and the gradients of all slots.
#[derive(CubeType, CubeLaunch)]
pub(super) struct SlotTarget {
    pub of: Box<[u32]>,
    pub gradients: Box<[f32]>,
}

/// The gradients of all splats, to be added to.
#[derive(CubeType, CubeLaunch)]
pub(super) struct SplatTarget<A: Numeric> {
    pub packed: Box<[Atomic<A>]>,
    pub colors: Box<[Atomic<A>]>,
    pub opacities: Box<[Atomic<A>]>,
}

/// Adds `value` to a float that other units add to, in memory that is an atomic float or an atomic
/// integer of its bits.
///
/// Where floats cannot be added: what is there is taken out (zero stays) and put back with more; if
/// something came in between, that is what is to be put next. Not by compare-and-swap: CubeCL's and
/// WGSL's may fail although it found what it was to compare with, as on Metal, and tells no more
/// than what it found, so that a sum would be lost.
#[cube]
fn add<A: Numeric>(to: &Atomic<A>, value: f32, #[comptime] sums: Sums) {
    if comptime!(sums == Sums::Atomic) {
        Atomic::fetch_add(to, A::reinterpret(value));
    } else {
        let mut carried = value;
        while carried != 0.0f32 {
            let there = f32::reinterpret(Atomic::exchange(to, A::reinterpret(0.0f32)));
            let sum = there + carried;
            carried = f32::reinterpret(Atomic::exchange(to, A::reinterpret(sum)));
        }
    }
}

/// Adds one value of a tile's to the gradient of `splat`, where it belongs.
#[cube]
pub(super) fn add_to_splat<A: Numeric>(
    gradients: &mut SplatTarget<A>,
    splat: usize,
    value: usize,
    sum: f32,
    channels: usize,
    first_channel: usize,
    #[comptime] layout: SlotLayout,
    #[comptime] sums: Sums,
) {
    if value >= comptime!(layout.first_color()) {
        let channel = first_channel + value - comptime!(layout.first_color());
        if comptime!(layout.colors) {
            add(&gradients.colors[splat * channels + channel], sum, sums);
        }
    } else if value >= comptime!(layout.first_absolute()) {
        if comptime!(layout.absolute) {
            let at = absolute_entry(splat, value, layout);
            add(&gradients.packed[at], sum, sums);
        }
    } else if comptime!(layout.shape) {
        if value == 5 {
            add(&gradients.opacities[splat], sum, sums);
        } else {
            add(
                &gradients.packed[splat * PROJECTED_WIDTH + packed_entry(value)],
                sum,
                sums,
            );
        }
    }
}

/// Where a gradient of the shape is in a packed splat: mean x, y are entries 0, 1; w11, w21, w22
/// are 3, 4, 5.
#[cube]
fn packed_entry(value: usize) -> usize {
    select(value < 2, value, value + 1)
}

/// Where an absolute gradient of the mean waits among the gradients of packed splats: in the place
/// of that of the extent, which has none. [`take_absolute`] takes it out. A buffer of its own would
/// be one more than many devices can bind.
#[cube]
fn absolute_entry(splat: usize, value: usize, #[comptime] layout: SlotLayout) -> usize {
    splat * PROJECTED_WIDTH + PROJECTED_EXTENT + value - comptime!(layout.first_absolute())
}

/// Moves the absolute gradients of the means out of the gradients of the extents, and clears these.
#[cube(launch)]
pub(super) fn take_absolute(grad_packed: &mut [f32], absgrad: &mut [f32], values: u32) {
    if ABSOLUTE_POS < values as usize {
        let at = ABSOLUTE_POS / ABSOLUTE * PROJECTED_WIDTH + PROJECTED_EXTENT;
        let at = at + ABSOLUTE_POS % ABSOLUTE;
        absgrad[ABSOLUTE_POS] = grad_packed[at];
        grad_packed[at] = 0.0f32;
    }
}

/// Sums the slots of every visible splat in order, and spreads them over the gradients; those of
/// the others are zero. One unit per (splat, value).
#[cube(launch)]
pub(super) fn sum_slots(
    slot_gradients: &[f32],
    visible: &[u32],
    order: &[u32],
    offsets: &[u32],
    grad_packed: &mut [f32],
    grad_colors: &mut [f32],
    grad_opacities: &mut [f32],
    splats: u32,
    channels: u32,
    first_channel: u32,
    #[comptime] layout: SlotLayout,
    #[comptime] first_launch: bool,
) {
    let values = comptime!(layout.values());
    let j = ABSOLUTE_POS / values;
    let value = ABSOLUTE_POS % values;
    if j < splats as usize {
        if j < visible[splats as usize] as usize {
            let mut sum = 0.0f32;
            for slot in offsets[j]..offsets[j + 1] {
                sum += slot_gradients[slot as usize * values + value];
            }
            spread(
                grad_packed,
                grad_colors,
                grad_opacities,
                order[j] as usize,
                value,
                sum,
                channels as usize,
                first_channel as usize,
                layout,
                first_launch,
            );
        }
        // The same unit, as that of a splat by its index.
        if visible[j] == visible[j + 1] {
            spread(
                grad_packed,
                grad_colors,
                grad_opacities,
                j,
                value,
                0.0f32,
                channels as usize,
                first_channel as usize,
                layout,
                first_launch,
            );
        }
    }
}

/// Puts one summed value of `splat` where it belongs.
#[cube]
fn spread(
    grad_packed: &mut [f32],
    grad_colors: &mut [f32],
    grad_opacities: &mut [f32],
    splat: usize,
    value: usize,
    sum: f32,
    channels: usize,
    first_channel: usize,
    #[comptime] layout: SlotLayout,
    #[comptime] first_launch: bool,
) {
    if value >= comptime!(layout.first_color()) {
        let channel = first_channel + value - comptime!(layout.first_color());
        if comptime!(layout.colors) {
            grad_colors[splat * channels + channel] = sum;
        }
    } else if value >= comptime!(layout.first_absolute()) {
        if comptime!(layout.absolute) {
            grad_packed[absolute_entry(splat, value, layout)] = sum;
        }
    } else if comptime!(layout.shape) {
        let at = splat * PROJECTED_WIDTH + packed_entry(value);
        if comptime!(first_launch) {
            if value == 5 {
                grad_opacities[splat] = sum;
            } else {
                grad_packed[at] = sum;
            }
            // The entries without gradient: depth, compensation, and the extents unless absolute
            // gradients wait there.
            if value < comptime!(if layout.absolute { 2usize } else { 4usize }) {
                grad_packed[splat * PROJECTED_WIDTH + select(value == 0, 2usize, value + 5)] =
                    0.0f32;
            }
        } else if value == 5 {
            grad_opacities[splat] += sum;
        } else {
            grad_packed[at] += sum;
        }
    }
}
