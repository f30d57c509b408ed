//! Interruption and progress of an adjustment.

use std::sync::atomic::{AtomicBool, Ordering};

/// A part of the work, whose progress is shown as a share of the whole.
#[derive(Clone, Copy)]
pub(crate) struct Watched<'a> {
    interrupt: &'a AtomicBool,
    /// Called with the share of the whole work that is done, by any thread.
    progress: &'a (dyn Fn(f64) + Sync),
    start: f64,
    share: f64,
}

impl<'a> Watched<'a> {
    /// The whole work, given up soon after the flag becomes true.
    pub fn whole(interrupt: &'a AtomicBool, progress: &'a (dyn Fn(f64) + Sync)) -> Self {
        Self {
            interrupt,
            progress,
            start: 0.0,
            share: 1.0,
        }
    }

    /// One of `count` equal parts.
    pub(super) fn part(self, index: usize, count: usize) -> Self {
        let share = self.share / count as f64;
        Self {
            start: self.start + index as f64 * share,
            share,
            ..self
        }
    }

    /// Says that `done` of `total` steps of this part are done.
    pub(super) fn done(&self, done: usize, total: usize) {
        (self.progress)(self.start + self.share * done as f64 / total as f64);
    }

    pub(super) fn is_interrupted(&self) -> bool {
        self.interrupt.load(Ordering::Relaxed)
    }
}
