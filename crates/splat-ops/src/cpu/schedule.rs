//! Scheduling of uneven work.

use core::cmp::Reverse;

use rayon::prelude::*;

/// Runs pieces of work on all threads, heaviest first; each idle thread takes the next piece, so
/// that all threads finish together. Returns the results in the order of the pieces.
pub(super) fn heaviest_first<P: Send, R: Send>(
    pieces: impl IntoIterator<Item = P>,
    work: impl Fn(usize) -> usize,
    run: impl Fn(usize, P) -> R + Sync,
) -> Vec<R> {
    let mut pieces: Vec<(usize, P)> = pieces.into_iter().enumerate().collect();
    pieces.sort_by_key(|(index, _)| Reverse(work(*index)));
    let mut results: Vec<(usize, R)> = pieces
        .into_iter()
        .par_bridge()
        .map(|(index, piece)| (index, run(index, piece)))
        .collect();
    results.sort_unstable_by_key(|(index, _)| *index);
    results.into_iter().map(|(_, result)| result).collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;

    #[test]
    fn the_heaviest_begins_and_results_are_in_order() {
        let work = [3, 9, 0, 9, 4];
        for threads in [1, 2, 8] {
            let begun = Mutex::new(vec![]);
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            let results = pool.unwrap().install(|| {
                let run = |index: usize, name: char| {
                    begun.lock().unwrap().push(index);
                    format!("{index}{name}")
                };
                heaviest_first("abcde".chars(), |index| work[index], run)
            });
            assert_eq!(results, ["0a", "1b", "2c", "3d", "4e"]);
            let mut begun = begun.into_inner().unwrap();
            if threads > 1 {
                begun.sort_by_key(|index| (Reverse(work[*index]), *index));
            }
            assert_eq!(begun, [1, 3, 4, 0, 2]);
        }
    }

    #[test]
    fn nothing_to_do_is_done() {
        assert!(heaviest_first([(); 0], |_| 0, |_, ()| ()).is_empty());
    }
}
