//! Limits on intersections, and the room reserved before they are counted.

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::{LazyLock, Mutex, MutexGuard};

use cubecl::prelude::*;

use super::{Frames, IntersectError};

/// Floats per intersection for which a 32-bit index always suffices; with more floats, fewer
/// intersections fit. The rasteriser keeps this many (`rasterize.rs` checks it).
pub const MAX_SLOT_VALUES: usize = 22;

/// Most intersections that can be listed: kernels use 32-bit indices, and the backward pass keeps
/// up to [`MAX_SLOT_VALUES`] floats per intersection.
pub const MAX_INTERSECTIONS: u64 = u32::MAX as u64 / MAX_SLOT_VALUES as u64;

/// Most intersections that a device can list: each takes one element in each of several buffers,
/// whose size the device limits.
pub(super) fn max_intersections(client: &Client) -> u64 {
    let largest_buffer = client.properties().memory.max_page_size;
    MAX_INTERSECTIONS.min(largest_buffer / size_of::<u32>() as u64)
}

/// Refuses too many intersections, before any list is allocated. No other place decides this.
pub(super) fn check_intersections(count: u64, limit: u64) -> Result<usize, IntersectError> {
    match usize::try_from(count) {
        Ok(intersections) if count <= limit => Ok(intersections),
        _ => Err(IntersectError::TooManyIntersections { count, limit }),
    }
}

/// Room for the next lists of one device and image size. Lists do not depend on the capacity, so
/// earlier calls never change a result.
pub(super) struct Room {
    key: u64,
}

/// Decaying maximum of recent intersection counts, by [`Room::key`].
static LATELY: LazyLock<Mutex<HashMap<u64, usize>>> = LazyLock::new(Mutex::default);

impl Room {
    pub(super) fn of(client: &Client, frames: &Frames) -> Self {
        let mut key = DefaultHasher::new();
        client.service_id().hash(&mut key);
        (frames.cameras, frames.width, frames.height).hash(&mut key);
        Self { key: key.finish() }
    }

    fn lately() -> MutexGuard<'static, HashMap<u64, usize>> {
        LATELY
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner())
    }

    /// Somewhat more than the recent maximum; `None` before the first call.
    pub(super) fn expected(&self) -> Option<usize> {
        let lately = *Self::lately().get(&self.key)?;
        (lately > 0).then(|| (lately + lately / 4).min(MAX_INTERSECTIONS as usize))
    }

    pub(super) fn found(&self, intersections: usize) {
        let mut all = Self::lately();
        let lately = all.entry(self.key).or_default();
        *lately = intersections.max(*lately - *lately / 16);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intersections_are_refused_from_the_first_one_whose_gradients_cannot_be_indexed() {
        for intersections in [0, 1, MAX_INTERSECTIONS] {
            let count = check_intersections(intersections, MAX_INTERSECTIONS);
            assert_eq!(count, Ok(intersections as usize));
            assert!(intersections * MAX_SLOT_VALUES as u64 <= u64::from(u32::MAX));
        }
        for intersections in [
            MAX_INTERSECTIONS + 1,
            1 << 31,
            1 << 32,
            (1 << 32) + 5,
            u64::MAX,
        ] {
            let error = check_intersections(intersections, MAX_INTERSECTIONS).unwrap_err();
            assert!(error.to_string().contains(&intersections.to_string()));
        }
    }
}
