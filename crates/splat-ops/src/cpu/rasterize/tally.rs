//! Who counts what the blending does, if anybody.

use super::lanes::LANES;

/// Told about the pixels of every (block, splat) pair.
pub(super) trait Tally {
    /// Alphas were evaluated; asks which of them are seen.
    fn tested(&mut self, seen: impl FnOnce() -> [bool; LANES]);
    /// Alphas may have been blended; asks which of them were.
    fn blended(&mut self, blended: impl FnOnce() -> [bool; LANES]);
}

/// Nobody counts, and it costs nothing.
impl Tally for () {
    #[inline(always)]
    fn tested(&mut self, _: impl FnOnce() -> [bool; LANES]) {}

    #[inline(always)]
    fn blended(&mut self, _: impl FnOnce() -> [bool; LANES]) {}
}
