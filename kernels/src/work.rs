//! Counters of kernel work: launches, memory, waits. For benchmarks; each count costs one atomic
//! addition.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

static LAUNCHES: AtomicU64 = AtomicU64::new(0);
static RESERVED: AtomicU64 = AtomicU64::new(0);
static WAITS: AtomicU64 = AtomicU64::new(0);
static INTERSECTIONS: AtomicU64 = AtomicU64::new(0);

/// Totals since the start of the process, over all threads and devices. Subtract two to measure a
/// step:
///
/// ```
/// let before = splat_kernels::work();
/// // ... a step ...
/// let step = splat_kernels::work().since(before);
/// assert_eq!(step.launches, 0);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Work {
    /// Launches of this crate's kernels; those of Burn and CubeCL are not counted.
    pub launches: u64,
    /// Bytes of device memory reserved for results and scratch; the device's pool may hand out the
    /// same bytes many times.
    pub reserved_bytes: u64,
    /// Times that the host waited for the device.
    pub waits: u64,
    /// Intersections listed, each of a splat and a tile.
    pub intersections: u64,
}

impl Work {
    /// Work done after `earlier`.
    #[must_use]
    pub fn since(self, earlier: Self) -> Self {
        Self {
            launches: self.launches - earlier.launches,
            reserved_bytes: self.reserved_bytes - earlier.reserved_bytes,
            waits: self.waits - earlier.waits,
            intersections: self.intersections - earlier.intersections,
        }
    }
}

/// The totals so far.
pub fn work() -> Work {
    Work {
        launches: LAUNCHES.load(Relaxed),
        reserved_bytes: RESERVED.load(Relaxed),
        waits: WAITS.load(Relaxed),
        intersections: INTERSECTIONS.load(Relaxed),
    }
}

pub(crate) fn launched() {
    LAUNCHES.fetch_add(1, Relaxed);
}

pub(crate) fn reserved(bytes: usize) {
    RESERVED.fetch_add(bytes as u64, Relaxed);
}

pub(crate) fn waited() {
    WAITS.fetch_add(1, Relaxed);
}

pub(crate) fn listed(intersections: usize) {
    INTERSECTIONS.fetch_add(intersections as u64, Relaxed);
}
