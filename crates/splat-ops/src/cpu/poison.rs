//! Test switch: fills memory that is about to be overwritten with NaN.

use core::sync::atomic::{AtomicBool, Ordering};

static POISON: AtomicBool = AtomicBool::new(false);

/// Applies to the whole process.
pub(crate) fn poison(on: bool) {
    POISON.store(on, Ordering::Relaxed);
}

pub(super) fn is_on() -> bool {
    POISON.load(Ordering::Relaxed)
}
