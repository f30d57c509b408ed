//! Decides whether the units of a plane (subgroup, warp, wavefront) may cooperate without shared
//! memory.

use std::sync::atomic::{AtomicU32, Ordering};

use cubecl::features::Plane;
use cubecl::prelude::*;

/// Size given to [`force_plane_size`], or [`ASK`].
static FORCED: AtomicU32 = AtomicU32::new(ASK);
const ASK: u32 = u32::MAX;

/// Makes kernels assume planes of this size on every device (none, for `Some(0)`), for the whole
/// process. For tests; `None` asks the device again.
#[doc(hidden)]
pub fn force_plane_size(size: Option<u32>) {
    FORCED.store(size.unwrap_or(ASK), Ordering::Relaxed);
}

/// Units of a plane, if the device has plane operations and all its planes have one common size. If
/// sizes vary, a kernel cannot know which size it will get, and works without planes.
pub fn plane_size(client: &Client) -> Option<usize> {
    let (least, most) = match FORCED.load(Ordering::Relaxed) {
        ASK if !client.features().plane.contains(Plane::Ops) => return None,
        ASK => {
            let hardware = &client.properties().hardware;
            (hardware.plane_size_min, hardware.plane_size_max)
        }
        forced => (forced, forced),
    };
    (least == most && [8, 16, 32, 64].contains(&least)).then_some(least as usize)
}
