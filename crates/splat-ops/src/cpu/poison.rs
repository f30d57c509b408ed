//! A switch of tests: whether memory that is to be overwritten is full of NaN before.

use core::sync::atomic::{AtomicBool, Ordering};

static POISON: AtomicBool = AtomicBool::new(false);

/// For the whole process.
pub(crate) fn poison(on: bool) {
    POISON.store(on, Ordering::Relaxed);
}

pub(super) fn is_on() -> bool {
    POISON.load(Ordering::Relaxed)
}
