//! Values that the backward pass sums for an intersection, and how many fit into shared memory.

use super::pair::SHAPE;
use super::tile::{BATCH, Plan, WORDS};

/// Gradients of a splat's shape and opacity in a slot, in the order of [`SHAPE`]; those of colours
/// follow.
pub(super) const SHAPE_GRADIENTS: usize = SHAPE;

/// Absolute gradients of a splat's screen mean, x and y.
pub(super) const ABSOLUTE: usize = 2;

/// Floats in the shared memory that every device has.
const SHARED: usize = 16_384 / 4;
/// Most floats of partial sums in it, where the batch leaves as many.
const MAX_PARTIALS: usize = 2304;

/// Which values a launch of the backward pass sums, and how many there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct SlotLayout {
    /// Gradients of shape and opacity, [`SHAPE_GRADIENTS`] of them, come first.
    pub shape: bool,
    /// Then absolute gradients of the mean, [`ABSOLUTE`] of them.
    pub absolute: bool,
    /// Then those of the colours.
    pub colors: bool,
    /// Channels of this launch.
    pub width: usize,
}

impl SlotLayout {
    pub fn values(self) -> usize {
        self.first_color() + if self.colors { self.width } else { 0 }
    }

    pub fn first_color(self) -> usize {
        self.first_absolute() + if self.absolute { ABSOLUTE } else { 0 }
    }

    pub fn first_absolute(self) -> usize {
        if self.shape { SHAPE_GRADIENTS } else { 0 }
    }

    /// Whether the launch is for absolute gradients alone. They need all channels of a pixel at
    /// once, so a launch that has not all of them reads them from memory.
    pub fn reads_all_channels(self) -> bool {
        self.absolute && !self.shape
    }

    /// Floats in shared memory beside the partial sums: the batch, its targets and bits, and how
    /// far the blocks have walked.
    pub fn batch(self, plan: Plan) -> usize {
        BATCH * (SHAPE + self.width) + 2 * BATCH + plan.blocks() * (WORDS + 1) + 2
    }

    /// Splats whose partial sums are in shared memory at once: a power of two, so that they share a
    /// word of bits.
    pub fn group(self, plan: Plan) -> usize {
        let room = SHARED.saturating_sub(self.batch(plan)).min(MAX_PARTIALS);
        let most = room / (self.values() * plan.blocks());
        let power = usize::BITS - 1 - most.max(1).leading_zeros();
        1 << power.min(5)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_layout_fits_into_the_shared_memory_of_any_device() {
        for lanes in [1, 8, 16, 32, 64] {
            let plan = Plan::with_lanes(lanes);
            for width in 1..=plan.channels() {
                for (shape, absolute, colors) in [
                    (true, true, true),
                    (true, false, true),
                    (true, true, false),
                    (true, false, false),
                    (false, false, true),
                    (false, true, false),
                ] {
                    let layout = SlotLayout {
                        shape,
                        absolute,
                        colors,
                        width,
                    };
                    let group = layout.group(plan);
                    assert!(32 % group == 0, "a group shares a word of bits");
                    let partials = group * layout.values() * plan.blocks();
                    let bytes = 4 * (layout.batch(plan) + partials);
                    assert!(bytes <= 16_384, "{bytes} bytes: {lanes} lanes, {layout:?}");
                }
            }
        }
    }
}
