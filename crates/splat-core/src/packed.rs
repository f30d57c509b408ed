//! Layout of the packed splats that `project` writes and `rasterize` reads.
//!
//! # Culling
//! A row of zeros is a culled splat. A splat is kept if its depth lies in `[near, far]`, its
//! quaternion has non-zero length, all of its fields are finite, and its box overlaps the image,
//! borders excluded:
//!
//! ```text
//! mean_x + extent_x > 0,  mean_x - extent_x < width,  mean_y + extent_y > 0,  mean_y - extent_y < height
//! ```
//! A box that only touches the border contains no pixel centre. Every backend compares strictly.

/// Floats per splat in the packed output of `project`:
/// `[mean_x, mean_y, depth, w11, w21, w22, compensation, extent_x, extent_y]`.
pub const PROJECTED_WIDTH: usize = 9;

/// Column of the depth, camera z.
pub const PROJECTED_DEPTH: usize = 2;

/// Column of `extent_x`, which is positive exactly for splats that are not culled.
pub const PROJECTED_EXTENT: usize = 7;

/// Size in pixels beyond which splats are treated alike: constant over any image.
pub const SPLAT_SIZE_MAX: f64 = 1e12;

/// Side of a tile of the rasteriser, in pixels.
pub const TILE_SIDE: usize = 16;
