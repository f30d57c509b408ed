//! Memory that threads write in parts. The writing thread clears its part just before, while it
//! lies in that core's cache; clearing everything at once would take another trip through main
//! memory.

use core::mem::MaybeUninit;
use core::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use super::overwritten::Overwritten;

/// Memory whose parts are not cleared yet.
pub(super) struct Uncleared<T> {
    /// Empty, with capacity for all values.
    values: Vec<T>,
    length: usize,
    /// Number of values that the current parts have cleared.
    cleared: AtomicUsize,
}

/// A part of the memory.
pub(super) struct Part<'a, T> {
    memory: &'a mut [MaybeUninit<T>],
    cleared: &'a AtomicUsize,
}

impl<T: Overwritten> Uncleared<T> {
    pub(super) fn new(length: usize) -> Self {
        Self {
            values: Vec::with_capacity(length),
            length,
            cleared: AtomicUsize::new(0),
        }
    }

    /// Consecutive parts of the given lengths.
    pub(super) fn parts(&mut self, lengths: impl IntoIterator<Item = usize>) -> Vec<Part<'_, T>> {
        *self.cleared.get_mut() = 0;
        let mut rest = &mut self.values.spare_capacity_mut()[..self.length];
        let lengths = lengths.into_iter().map(|length| {
            let (memory, after) = core::mem::take(&mut rest).split_at_mut(length);
            rest = after;
            Part {
                memory,
                cleared: &self.cleared,
            }
        });
        lengths.collect()
    }

    /// Parts of one length; the last one may be shorter.
    pub(super) fn chunks(&mut self, length: usize) -> Vec<Part<'_, T>> {
        let (all, length) = (self.length, length.max(1));
        self.parts(
            (0..all)
                .step_by(length)
                .map(|first| length.min(all - first)),
        )
    }

    /// [`chunks`](Self::chunks) of each of several equal pieces: index of the piece, index of the
    /// first value in it, and the part.
    pub(super) fn chunks_of_each(
        &mut self,
        pieces: usize,
        length: usize,
    ) -> Vec<(usize, usize, Part<'_, T>)> {
        let (all, length) = (self.length.checked_div(pieces).unwrap_or(0), length.max(1));
        let places = (0..pieces).flat_map(|piece| {
            let firsts = (0..all).step_by(length);
            firsts.map(move |first| (piece, first))
        });
        let parts = self.parts(places.clone().map(|(_, first)| length.min(all - first)));
        let places = places.zip(parts);
        places
            .map(|((piece, first), part)| (piece, first, part))
            .collect()
    }

    /// The written memory.
    ///
    /// # Panics
    /// If a part was never cleared, which is a bug of the caller and depends on no input.
    pub(super) fn written(self) -> Vec<T> {
        let Self {
            mut values,
            length,
            mut cleared,
        } = self;
        assert_eq!(*cleared.get_mut(), length, "a part was never cleared");
        // SAFETY: parts do not overlap, and clearing one consumes it. As the current parts have
        // cleared as many values as there are, they have cleared all.
        unsafe { values.set_len(length) };
        values
    }
}

impl<'a, T: Overwritten> Part<'a, T> {
    /// The part, filled with zeros.
    pub(super) fn cleared(self) -> &'a mut [T] {
        self.filled(T::CLEAR)
    }

    /// The part, for values that are all written before any is read. Tests fill it with NaN first.
    pub(super) fn overwritten(self) -> &'a mut [T] {
        #[cfg(test)]
        if super::poison::is_on() {
            return self.filled(T::POISON);
        }
        self.cleared()
    }

    fn filled(self, value: T) -> &'a mut [T] {
        for place in &mut *self.memory {
            place.write(value);
        }
        self.cleared.fetch_add(self.memory.len(), Relaxed);
        // SAFETY: written just now.
        unsafe { self.memory.assume_init_mut() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_parts_wrote_is_there_and_the_rest_is_zero() {
        let mut memory = Uncleared::<f32>::new(10);
        for (index, part) in memory.parts([3, 0, 7]).into_iter().enumerate() {
            let part = part.cleared();
            if let Some(first) = part.first_mut() {
                *first = 1.0 + index as f32;
            }
        }
        let expected = [1.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        assert_eq!(memory.written(), expected);
    }

    #[test]
    fn chunks_cover_everything() {
        for (length, chunk, expected) in
            [(10, 4, vec![4, 4, 2]), (0, 4, vec![]), (3, 0, vec![1; 3])]
        {
            let mut memory = Uncleared::<u32>::new(length);
            let parts = memory.chunks(chunk).into_iter();
            let lengths: Vec<usize> = parts.map(|part| part.cleared().len()).collect();
            assert_eq!(lengths, expected);
            assert_eq!(memory.written(), vec![0; length]);
        }
    }

    #[test]
    fn chunks_of_each_know_where_they_lie() {
        let mut memory = Uncleared::<u32>::new(10);
        for (piece, first, part) in memory.chunks_of_each(2, 3) {
            for (value, at) in part.cleared().iter_mut().zip(first..) {
                *value = (5 * piece + at) as u32;
            }
        }
        assert_eq!(memory.written(), (0..10).collect::<Vec<u32>>());
        let mut nothing = Uncleared::<u32>::new(0);
        assert!(nothing.chunks_of_each(0, 3).is_empty());
    }

    #[test]
    #[should_panic(expected = "a part was never cleared")]
    fn a_part_that_nobody_cleared_is_found() {
        let mut memory = Uncleared::<f32>::new(4);
        drop(memory.chunks(2));
        memory.written();
    }
}
