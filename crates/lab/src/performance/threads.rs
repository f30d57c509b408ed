//! Where measured work runs.

use rayon::ThreadPoolBuilder;

use super::PerformanceError;

/// Runs `work` in a pool of so many threads. Burn's Flex and our ops take the pool that they are
/// called in; only the calls themselves must not come from outside.
///
/// # Errors
/// When the system has no such threads, or the work fails.
pub fn on_threads<R: Send>(
    threads: usize,
    work: impl FnOnce() -> Result<R, PerformanceError> + Send,
) -> Result<R, PerformanceError> {
    ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()?
        .install(work)
}

/// One thread, and as many as a run would take; without the second where they are the same.
pub fn all_threads() -> Vec<usize> {
    let most = std::thread::available_parallelism().map_or(1, |n| n.get());
    if most > 1 { vec![1, most] } else { vec![1] }
}
