//! Ctrl-C: the first finishes the current step, the second ends the program at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Exit status of a program ended by Ctrl-C, by the convention of shells.
pub(super) const STATUS: u8 = 130;

/// A flag that the first Ctrl-C sets.
pub(super) fn flag() -> Result<Arc<AtomicBool>, ctrlc::Error> {
    let flag = Arc::new(AtomicBool::new(false));
    let seen = Arc::clone(&flag);
    ctrlc::set_handler(move || {
        if seen.swap(true, Ordering::Relaxed) {
            std::process::exit(STATUS.into());
        }
    })?;
    Ok(flag)
}
