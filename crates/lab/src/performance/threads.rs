//! Thread pools for measured work.

use rayon::ThreadPoolBuilder;

use super::PerformanceError;

/// Runs `work` in a pool with this many threads. Burn's Flex and our ops use the pool that they are
/// called in.
///
/// # Errors
/// When the threads cannot be started, or the work fails.
pub fn on_threads<R: Send>(
    threads: usize,
    work: impl FnOnce() -> Result<R, PerformanceError> + Send,
) -> Result<R, PerformanceError> {
    ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()?
        .install(work)
}

/// One thread, and as many as a run would use; only one entry if they are equal.
pub fn all_threads() -> Vec<usize> {
    let most = std::thread::available_parallelism().map_or(1, |n| n.get());
    if most > 1 { vec![1, most] } else { vec![1] }
}
