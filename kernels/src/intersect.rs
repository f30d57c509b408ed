//! Lists the splats that touch each tile, front to back (3DGS section 6).
//!
//! Visible splats are compacted in the order of their index and sorted by depth (equal depths by
//! index). Each emits the tiles it touches in that order; a stable sort by tile then leaves every
//! tile's list in depth order. An *intersection* is one (splat, tile) pair, and its *slot* is its
//! position in the order of emission. The slots of one splat are consecutive, so gradients written
//! to slots can be summed splat by splat, in order.
//!
//! A splat touches a tile iff the ellipse `opacity exp(-sigma) >= alpha_min` meets the rectangle of
//! the tile's pixel centres: sigma is convex, so unless its centre lies in the rectangle its
//! minimum lies on an edge that faces it. One unit tests the tiles of one splat; a splat over more
//! than 64 tiles is shared by its workgroup.
//!
//! Floor: 28 bytes read per splat and 8 written per visible one; then per visible splat 32 bytes
//! twice (counting and emitting) and about 40 operations per tile of its bounding box; per
//! intersection 12 bytes written, and read again after the sort.

mod capacity;
mod footprint;
mod kernels;
mod lists;

use std::fmt;

use cubecl::prelude::*;
use splat_core::TILE_SIDE;

pub use self::capacity::{MAX_INTERSECTIONS, MAX_SLOT_VALUES};
use self::capacity::{Room, check_intersections, max_intersections};
pub(crate) use self::footprint::Footprint;
use self::lists::Counted;
use crate::bytes::{Bytes, Sizes};
use crate::launch::Buffer;
use crate::scan::PendingTotal;
use crate::work;

/// Side of a tile in pixels.
pub const TILE: u32 = TILE_SIDE as u32;

/// Images that are rendered together.
#[derive(Clone, Copy, Debug)]
pub struct Frames {
    /// C, number of cameras.
    pub cameras: usize,
    /// N, Gaussians per camera.
    pub gaussians: usize,
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Alpha below which a splat is invisible.
    pub alpha_min: f32,
}

impl Frames {
    /// Tiles of all images.
    pub fn tiles(&self) -> usize {
        self.cameras * self.width.div_ceil(TILE) as usize * self.height.div_ceil(TILE) as usize
    }

    /// Screen splats of all cameras.
    pub fn splats(&self) -> usize {
        self.cameras * self.gaussians
    }

    pub(crate) fn uniforms(&self) -> GridLaunch {
        GridLaunch::new(
            self.gaussians as u32,
            self.splats() as u32,
            self.tiles() as u32,
            self.width,
            self.height,
            self.width.div_ceil(TILE),
            self.height.div_ceil(TILE),
            self.alpha_min,
        )
    }
}

/// [`Frames`] on the device.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
#[expand(derive(Clone, Copy))]
pub(crate) struct Grid {
    pub gaussians: u32,
    pub splats: u32,
    /// Tiles of all cameras.
    pub tiles: u32,
    pub width: u32,
    pub height: u32,
    pub columns: u32,
    pub rows: u32,
    pub alpha_min: f32,
}

/// The lists of all tiles of all cameras.
#[derive(Clone, Debug)]
pub struct TileLists {
    /// Number of intersections.
    pub intersections: usize,
    /// Splat (camera N + Gaussian) of every intersection, by tile, front to back. The buffer may
    /// have spare capacity.
    pub splats: Buffer,
    /// First intersection and end of each tile [tiles, 2].
    pub ranges: Buffer,
    /// Present only for ordered sums.
    pub slots: Option<Slots>,
}

/// A slot for each intersection; those of one splat are consecutive.
#[derive(Clone, Debug)]
pub struct Slots {
    /// Slot of each intersection, in the order of the tiles' lists.
    pub of: Buffer,
    /// Number of visible splats of a lower index; the last entry is their total number V [splats +
    /// 1].
    pub visible: Buffer,
    /// Visible splats, front to back: V of them, in a buffer for all.
    pub order: Buffer,
    /// `offsets[j]..offsets[j + 1]`: the slots of splat `order[j]`, for j < V of [splats + 1].
    pub offsets: Buffer,
}

/// Errors of listing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum IntersectError {
    /// More intersections than can be indexed or than a device buffer can hold.
    TooManyIntersections {
        /// Number of intersections.
        count: u64,
        /// Most that can be listed.
        limit: u64,
    },
    /// The device failed, with its message.
    Device(String),
}

impl fmt::Display for IntersectError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooManyIntersections { count, limit } => write!(
                f,
                "{count} intersections of splats and tiles; at most {limit} can be rendered at once"
            ),
            Self::Device(error) => write!(f, "the device failed: {error}"),
        }
    }
}

impl std::error::Error for IntersectError {}

/// Floor of the listing for one camera, without the sorts.
pub(crate) fn floor(sizes: &Sizes) -> Bytes {
    Bytes {
        read: 28 * sizes.gaussians + 64 * sizes.visible + 12 * sizes.intersections,
        written: 8 * sizes.visible + 12 * sizes.intersections,
    }
}

/// Lists the splats of every tile, from `packed` [C, N, 9] and `opacities` [C, N]. Waits for the
/// device once, to learn the number of intersections.
///
/// # Errors
/// More intersections than can be indexed or than a device buffer can hold, or a device failure.
pub fn intersect(
    client: &Client,
    packed: &Buffer,
    opacities: &Buffer,
    frames: &Frames,
) -> Result<TileLists, IntersectError> {
    let (counted, total) = Counted::new(client, packed, opacities, frames);
    let intersections = wait_for_intersections(client, total)?;
    Ok(counted.list(client, intersections))
}

/// Lists the splats of every tile as [`intersect`] does, and passes the lists to `then` without
/// stalling the device. Reserves somewhat more room than recent calls needed, and checks the actual
/// number once everything is under way. If the room was too small, repeats the work.
pub(crate) fn intersect_ahead<R>(
    client: &Client,
    packed: &Buffer,
    opacities: &Buffer,
    frames: &Frames,
    then: impl Fn(&TileLists) -> R,
) -> Result<(TileLists, R), IntersectError> {
    let (counted, total) = Counted::new(client, packed, opacities, frames);
    let limit = max_intersections(client) as usize;
    let room = Room::of(client, frames);
    let ahead = room.expected().map(|capacity| {
        let capacity = capacity.min(limit);
        let lists = counted.list(client, capacity);
        let result = then(&lists);
        (lists, result)
    });
    let intersections = wait_for_intersections(client, total)?;
    room.found(intersections);
    Ok(match ahead {
        Some((mut lists, result)) if intersections <= lists.intersections => {
            lists.intersections = intersections;
            (lists, result)
        }
        _ => {
            let lists = counted.list(client, intersections);
            let result = then(&lists);
            (lists, result)
        }
    })
}

fn wait_for_intersections(
    client: &Client,
    total: PendingTotal<'_>,
) -> Result<usize, IntersectError> {
    let count = total.wait().map_err(IntersectError::Device)?;
    let intersections = check_intersections(count, max_intersections(client))?;
    work::listed(intersections);
    Ok(intersections)
}
