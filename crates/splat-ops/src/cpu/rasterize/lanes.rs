//! The pixels of a block, side by side.

/// Side of a block, the pixels that are worked on at once: as long as it is wide, since then fewest
/// pixels are tested that a splat does not reach, whatever way it lies.
pub(super) const SIDE: usize = 4;

/// Pixels of a block, row by row.
pub(super) const LANES: usize = SIDE * SIDE;

/// One value per pixel of a block.
pub(super) type Lanes<T> = [T; LANES];

/// As wide registers want it in memory: what lies across two lines of the cache is read and written
/// twice as slowly.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
pub(super) struct Aligned<V>(pub(super) V);
