//! Rows of a buffer chosen in groups of consecutive ones, see `splat_core::RowGroups`.

use cubecl::prelude::*;

/// The row that is number `index` among the chosen ones, in groups of `size`. Only the last group
/// may be smaller, so that the place in the list follows from the index.
#[cube]
pub(crate) fn row_of(groups: &[u32], index: usize, size: usize) -> usize {
    groups[index / size] as usize * size + index % size
}
