//! Keeps worker threads awake between ops.

use core::cell::Cell;
use core::time::Duration;
use std::thread;
use std::time::Instant;

use rayon::Yield;

/// How long an idle thread spins before it sleeps: ten times the gap between two ops in a step of
/// 15,000 Gaussians (docs/PERFORMANCE.md, stages).
const PATIENCE: Duration = Duration::from_micros(500);

thread_local! {
    /// True while this thread spins.
    static LOOKS: Cell<bool> = const { Cell::new(false) };
}

/// Makes the other threads of the pool spin until there has been no work for a while.
pub(crate) fn keep_awake() {
    let own = rayon::current_thread_index();
    if rayon::current_num_threads() > usize::from(own.is_some()) {
        rayon::spawn_broadcast(move |thread| {
            if Some(thread.index()) != own {
                look_for_work();
            }
        });
    }
}

fn look_for_work() {
    // A spinning thread may pick up the next request to spin.
    if LOOKS.replace(true) {
        return;
    }
    let mut found = Instant::now();
    while found.elapsed() < PATIENCE {
        match rayon::yield_now() {
            Some(Yield::Executed) => found = Instant::now(),
            _ => thread::yield_now(),
        }
    }
    LOOKS.set(false);
}

#[cfg(test)]
mod tests {
    use rayon::prelude::*;

    use super::*;

    fn pool() -> rayon::ThreadPool {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build();
        pool.unwrap()
    }

    /// Which threads of the pool are spinning, once asked to.
    fn looking() -> Vec<bool> {
        keep_awake();
        rayon::broadcast(|_| LOOKS.get())
    }

    #[test]
    fn all_threads_but_the_callers_look_for_work() {
        // A busy machine may preempt a thread for longer than it spins.
        let asked = |expected: &dyn Fn(usize) -> bool| {
            (0..1000).any(|_| (looking().into_iter().enumerate()).all(|(i, on)| on == expected(i)))
        };
        assert!(pool().install(|| {
            let own = rayon::current_thread_index();
            asked(&|index| Some(index) != own)
        }));
        // From outside the pool, all threads are free to spin.
        assert!(asked(&|_| true));
    }

    #[test]
    fn threads_that_look_for_work_do_it_and_then_rest() {
        let pool = pool();
        let sum: usize = pool.install(|| {
            // More requests than a stack could hold if each were answered inside the last one.
            for _ in 0..100_000 {
                keep_awake();
            }
            (0..1000)
                .into_par_iter()
                .map(|i| (0..=i).into_par_iter().map(|j| j % 2).sum::<usize>())
                .sum()
        });
        assert_eq!(sum, (0..1000usize).map(|i| i.div_ceil(2)).sum::<usize>());
        // A busy machine may preempt a thread for longer than it spins, and asking is work too:
        // retry, less often.
        assert!((0..1000).any(|_| {
            thread::sleep(10 * PATIENCE);
            pool.broadcast(|_| LOOKS.get()) == [false; 3]
        }));
    }
}
