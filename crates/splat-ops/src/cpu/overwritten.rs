//! Memory that is written before it is read.

use rayon::prelude::*;

/// Memory for `len` values, all written before any is read. Tests fill it with NaN first.
pub(crate) fn overwritten<T: Overwritten + bytemuck::Pod>(len: usize) -> Vec<T> {
    #[cfg(test)]
    if super::poison::is_on() {
        return vec![T::POISON; len];
    }
    zeros(len)
}

/// Zeros. Large buffers are cleared by all threads, as one thread would be too slow within a step.
pub(crate) fn zeros<T: Overwritten + bytemuck::Pod>(len: usize) -> Vec<T> {
    const BLOCK: usize = 1024;
    if len < 64 * BLOCK {
        return vec![T::CLEAR; len];
    }
    let blocks = rayon::iter::repeat_n([T::CLEAR; BLOCK], len.div_ceil(BLOCK));
    let blocks: Vec<[T; BLOCK]> = blocks.collect();
    let mut values = bytemuck::allocation::cast_vec(blocks);
    values.truncate(len);
    values
}

/// Contents of [`overwritten`] memory before it is written.
pub(crate) trait Overwritten: Copy + Send + Sync {
    /// Zero.
    const CLEAR: Self;
    /// NaN, or for indices a value far outside any list.
    #[cfg(test)]
    const POISON: Self;
}

macro_rules! overwritten {
    ($type:ty, $poison:expr) => {
        impl Overwritten for $type {
            const CLEAR: Self = 0 as $type;
            #[cfg(test)]
            const POISON: Self = $poison;
        }
    };
}

overwritten!(f32, f32::NAN);
overwritten!(f64, f64::NAN);
overwritten!(u32, 0x7fc0_0000);
overwritten!(i32, 0x7fc0_0000);
