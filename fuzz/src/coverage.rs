//! Branch coverage of the readers, if they were compiled with LLVM's counters
//! (`fuzz/instrument.sh`). In other builds there are no counters, and everything here is empty.
//!
//! The compiler puts an 8-bit counter on every edge of the control flow. At program start it calls
//! the two functions below with all counters, and with an address and flags for each.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicU8, Ordering};

/// An entry of LLVM's table of addresses.
#[repr(C)]
struct Place {
    address: usize,
    /// Bit 0: the first edge of a function.
    flags: usize,
}

static COUNTERS: OnceLock<&'static [AtomicU8]> = OnceLock::new();
static PLACES: OnceLock<&'static [Place]> = OnceLock::new();

/// Called by every instrumented unit, always with the same range, as the linker has merged them.
///
/// # Safety
/// `start..stop` must be bytes that live as long as the program.
#[unsafe(no_mangle)]
unsafe extern "C" fn __sanitizer_cov_8bit_counters_init(
    start: *const AtomicU8,
    stop: *const AtomicU8,
) {
    // SAFETY: guaranteed by the caller; the counters are only incremented, byte by byte.
    COUNTERS.get_or_init(|| unsafe {
        std::slice::from_raw_parts(start, stop.offset_from_unsigned(start))
    });
}

/// The same for the addresses.
///
/// # Safety
/// `start..stop` must be entries that live as long as the program.
#[unsafe(no_mangle)]
unsafe extern "C" fn __sanitizer_cov_pcs_init(start: *const Place, stop: *const Place) {
    // SAFETY: guaranteed by the caller.
    PLACES.get_or_init(|| unsafe {
        std::slice::from_raw_parts(start, stop.offset_from_unsigned(start))
    });
}

/// Coverage of all runs of a campaign.
#[derive(Default)]
pub struct Reached {
    /// Per edge, one bit for each magnitude of its counter seen so far.
    seen: Vec<u8>,
}

/// Edges of the functions that were entered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Edges {
    /// Taken at least once.
    pub taken: usize,
    /// Total number.
    pub present: usize,
    /// Number of functions.
    pub functions: usize,
}

/// True if there are counters.
pub fn is_counted() -> bool {
    !counters().is_empty()
}

/// Resets all counters.
pub fn clear() {
    for counter in counters() {
        counter.store(0, Ordering::Relaxed);
    }
}

fn counters() -> &'static [AtomicU8] {
    COUNTERS.get().copied().unwrap_or_default()
}

impl Reached {
    /// Adds the current counters; returns true if any shows something new.
    pub fn add(&mut self) -> bool {
        let counters = counters();
        self.seen.resize(counters.len(), 0);
        let mut news = false;
        for (seen, counter) in self.seen.iter_mut().zip(counters) {
            let count = counter.load(Ordering::Relaxed);
            if count > 0 {
                let bit = 1 << count.ilog2();
                news |= *seen & bit == 0;
                *seen |= bit;
            }
        }
        news
    }

    /// Edges of the functions that were entered, by the table of addresses.
    pub fn edges(&self) -> Edges {
        let places = PLACES.get().copied().unwrap_or_default();
        let mut edges = Edges::default();
        let mut at = 0;
        while at < places.len() {
            debug_assert!(places[at].address != 0);
            let next = places[at + 1..]
                .iter()
                .position(|place| place.flags & 1 == 1);
            let end = next.map_or(places.len(), |offset| at + 1 + offset);
            let seen = self.seen.get(at..end).unwrap_or_default();
            let taken = seen.iter().filter(|seen| **seen != 0).count();
            if taken > 0 {
                edges.taken += taken;
                edges.present += end - at;
                edges.functions += 1;
            }
            at = end;
        }
        edges
    }
}
