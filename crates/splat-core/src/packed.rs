//! Layout of the packed splats that `project` writes and `rasterize` reads.

/// Floats per splat in the packed output of `project`:
/// `[mean_x, mean_y, depth, w11, w21, w22, compensation, extent_x, extent_y]`.
pub const PROJECTED_WIDTH: usize = 9;

/// Column of `extent_x`, which is above zero exactly where the splat was not culled.
pub const PROJECTED_EXTENT: usize = 7;
