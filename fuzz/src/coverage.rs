//! Which branches of the readers have been taken, where they were compiled with LLVM's counters
//! (`fuzz/instrument.sh`); in a build without them there are none, and everything here is empty.
//!
//! The compiler puts an 8-bit counter on every edge of the control flow and calls the two functions
//! below at the start of the program, with all counters and with an address and a flag for each.

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

/// Called by every instrumented unit, always with the same range: the linker has joined them.
///
/// # Safety
/// `start..stop` are bytes that live as long as the program.
#[unsafe(no_mangle)]
unsafe extern "C" fn __sanitizer_cov_8bit_counters_init(
    start: *const AtomicU8,
    stop: *const AtomicU8,
) {
    // SAFETY: the caller's promise; the counters are only added to, byte by byte.
    COUNTERS.get_or_init(|| unsafe {
        std::slice::from_raw_parts(start, stop.offset_from_unsigned(start))
    });
}

/// The same for the addresses.
///
/// # Safety
/// `start..stop` are entries that live as long as the program.
#[unsafe(no_mangle)]
unsafe extern "C" fn __sanitizer_cov_pcs_init(start: *const Place, stop: *const Place) {
    // SAFETY: the caller's promise.
    PLACES.get_or_init(|| unsafe {
        std::slice::from_raw_parts(start, stop.offset_from_unsigned(start))
    });
}

/// What all runs of a campaign have reached.
#[derive(Default)]
pub struct Reached {
    /// Per edge a bit for each magnitude of its counter that was seen.
    seen: Vec<u8>,
}

/// Edges of the functions that were entered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Edges {
    /// Taken at least once.
    pub taken: usize,
    /// In all.
    pub present: usize,
    /// In so many functions.
    pub functions: usize,
}

/// Whether there are counters.
pub fn is_counted() -> bool {
    !counters().is_empty()
}

/// Sets all counters to zero.
pub fn clear() {
    for counter in counters() {
        counter.store(0, Ordering::Relaxed);
    }
}

fn counters() -> &'static [AtomicU8] {
    COUNTERS.get().copied().unwrap_or_default()
}

impl Reached {
    /// Adds the counters as they are; says whether any shows something new.
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
