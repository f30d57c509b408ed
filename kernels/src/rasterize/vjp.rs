//! The launches of the backward pass.

use cubecl::prelude::*;
use splat_core::{PROJECTED_WIDTH, RasterizeTensors};

use super::background::background_gradient;
use super::backward::rasterize_backward;
use super::pair::thresholds;
use super::slots::{ABSOLUTE, SHAPE_GRADIENTS, SlotLayout};
use super::sums::{SlotTargetLaunch, SplatTargetLaunch, TargetArgs, sum_slots, take_absolute};
use super::tile::Plan;
use super::{RasterizeInputs, RasterizeSettings, RasterizeState, Sums};
use crate::intersect::{Frames, Slots};
use crate::launch::{Buffer, cube_count, per_element};

/// Most channels of one launch of the backward pass, of `most` that it could do: the slots of all
/// intersections must fit into a buffer of `bytes`, and within reach of an index.
fn slot_channels(most: usize, bytes: u64, intersections: usize, absolute: bool) -> usize {
    let floats = (bytes / 4).min(u64::from(u32::MAX));
    let values = (floats / intersections.max(1) as u64) as usize;
    let shape = SHAPE_GRADIENTS + if absolute { ABSOLUTE } else { 0 };
    values.saturating_sub(shape).clamp(1, most)
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

/// Gradients of packed splats [C, N, 9], colours [C, N, D], opacities [C, N] and background [C, D],
/// and absolute gradients of the screen means [C, N, 2], for the gradient of the output [C, H, W,
/// D + 1]; only those that `needs_grad` names. In order if `state` has slots.
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
    let absolute = needs_grad.absgrad;
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
        reserve(shape || absolute, splats * PROJECTED_WIDTH),
        reserve(needs_grad.colors, splats * channels),
        reserve(shape, splats),
    ];

    if shape || needs_grad.colors || absolute {
        let plan = Plan::new(client);
        let page = client.properties().memory.max_page_size;
        let width = match sums {
            Sums::Ordered => slot_channels(plan.channels(), page, lists.intersections, absolute),
            Sums::Atomic | Sums::Exchange => plan.channels(),
        };
        // Absolute gradients need all channels at once. Where the others go in several launches, or
        // are not asked for, these have one of their own.
        let together = absolute && shape && width >= channels;
        let firsts = (0..channels).step_by(width);
        let layouts = firsts
            .filter(|_| shape || needs_grad.colors)
            .map(|first_channel| {
                let layout = SlotLayout {
                    shape,
                    absolute: together,
                    colors: needs_grad.colors,
                    width: width.min(channels - first_channel),
                };
                (layout, first_channel)
            });
        let alone = SlotLayout {
            shape: false,
            absolute: true,
            colors: false,
            width: 1,
        };
        let alone = (absolute && !together).then_some((alone, 0));
        for (layout, first_channel) in layouts.chain(alone) {
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
    let grad_absolute = absolute.then(|| {
        let len = splats * ABSOLUTE;
        let taken = Buffer::empty(client, len);
        if let Some((count, dim)) = per_element(len) {
            take_absolute::launch(
                client,
                count,
                dim,
                grad_packed.arg(),
                taken.arg(),
                len as u32,
            );
        }
        taken
    });
    RasterizeTensors {
        packed: needs_grad.packed.then_some(grad_packed),
        colors: needs_grad.colors.then_some(grad_colors),
        opacities: needs_grad.opacities.then_some(grad_opacities),
        background: (needs_grad.background && inputs.background.is_some())
            .then(|| background_gradient(client, state, grad_output, channels, frames)),
        absgrad: grad_absolute,
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
        let slot_gradients = zeros(self.client, self.state.lists.intersections * values);
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
        if state.lists.intersections == 0 {
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
    use crate::intersect::MAX_INTERSECTIONS;

    #[test]
    fn the_more_intersections_the_fewer_channels_at_once() {
        assert_eq!(slot_channels(32, 1 << 40, 0, false), 32);
        assert_eq!(slot_channels(32, 1 << 40, 1_000_000, false), 32);
        assert_eq!(
            slot_channels(32, 1 << 40, MAX_INTERSECTIONS as usize, false),
            16
        );
        // 128 MiB: 33 floats for each of a million intersections, 3 for each of eleven million.
        assert_eq!(slot_channels(32, 1 << 27, 1_000_000, false), 27);
        assert_eq!(slot_channels(32, 1 << 27, 11_000_000, false), 1);
        for intersections in [1, 1000, 1 << 20, MAX_INTERSECTIONS] {
            let values =
                SHAPE_GRADIENTS + slot_channels(32, 1 << 40, intersections as usize, false);
            assert!(intersections * values as u64 <= u64::from(u32::MAX));
        }
    }
}
