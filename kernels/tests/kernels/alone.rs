//! Serialises tests of process-wide counters.

use std::sync::{Mutex, MutexGuard, PoisonError};

use cubecl::client::Client;

static ALONE: Mutex<()> = Mutex::new(());

/// A client that no other test uses while the guard lives.
pub fn alone() -> Option<(MutexGuard<'static, ()>, Client)> {
    let guard = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    Some((guard, crate::adapter::find()?))
}
