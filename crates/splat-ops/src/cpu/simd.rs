//! Code for the running processor, chosen at run time, so that one binary runs everywhere.

use core::ops::Range;

/// Defines a function whose body is compiled for the baseline, for AVX2 with FMA, and for AVX-512,
/// and which runs the best version that the processor supports. Functions called by the body must
/// be `#[inline(always)]`, or they stay compiled for the baseline.
///
/// `FMA` tells the body whether fused multiply-add is an instruction (otherwise it is a call). Rust
/// never fuses by itself: unless the body asks for it, the results are the same either way.
/// `with L: Trait<T>,` adds a type between the two.
macro_rules! vectorized {
    (
        $(#[$meta:meta])*
        $vis:vis fn $name:ident<T: Real, $(with $other:ident: $bound:ident<T>,)? const FMA: bool>($($argument:ident: $type:ty),* $(,)?) $(-> $result:ty)? $body:block
    ) => {
        $(#[$meta])*
        $vis fn $name<T: Real, $($other: $bound<T>)?>($($argument: $type),*) $(-> $result)? {
            #[inline(always)]
            fn body<T: Real, $($other: $bound<T>,)? const FMA: bool>($($argument: $type),*) $(-> $result)? $body

            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,fma")]
                fn avx2<T: Real, $($other: $bound<T>)?>($($argument: $type),*) $(-> $result)? {
                    body::<T, $($other,)? true>($($argument),*)
                }
                // Twice as many registers, so that constants stay in them; and masks.
                #[target_feature(enable = "avx2,fma,avx512f,avx512bw,avx512dq,avx512vl")]
                fn avx512<T: Real, $($other: $bound<T>)?>($($argument: $type),*) $(-> $result)? {
                    body::<T, $($other,)? true>($($argument),*)
                }
                match $crate::cpu::InstructionSet::chosen() {
                    // SAFETY: `chosen` has checked that the processor has these features.
                    $crate::cpu::InstructionSet::Avx512 => return unsafe { avx512::<T, $($other)?>($($argument),*) },
                    // SAFETY: as above.
                    $crate::cpu::InstructionSet::Avx2 => return unsafe { avx2::<T, $($other)?>($($argument),*) },
                    _ => {}
                }
            }
            // Every 64-bit Arm processor has fused multiply-add.
            body::<T, $($other,)? { cfg!(any(target_arch = "aarch64", target_feature = "fma")) }>($($argument),*)
        }
    };
}

pub(super) use vectorized;

/// Prefetches a range of items, as far as they exist, into the cache.
#[inline(always)]
pub(super) fn prefetch<V>(items: &[V], range: Range<usize>) {
    #[cfg(target_arch = "x86_64")]
    if let Some(items) = items.get(range.start..range.end.min(items.len())) {
        use core::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        /// Bytes of a cache line.
        const LINE: usize = 64;
        let (start, bytes) = (items.as_ptr().cast::<i8>(), size_of_val(items));
        // If items are not aligned to lines, the last line may hold a little more.
        let last = (align_of::<V>() < LINE).then_some(bytes.saturating_sub(1));
        for byte in (0..bytes).step_by(LINE).chain(last) {
            // SAFETY: every 64-bit x86 processor supports the instruction, which reads nothing.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(start.wrapping_add(byte)) }
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (items, range);
}

/// Rows processed together. Enough for any register width, and few enough for dozens of columns in
/// the L1 cache.
pub(super) const LANES: usize = 32;

/// One number for each of [`LANES`] rows. A loop over lanes without branches and calls becomes SIMD
/// code.
pub(super) type Lanes<T> = [T; LANES];

/// Passes on the rows that `is_kept`, in order, up to [`LANES`] at a time.
pub(super) fn for_each_block(
    rows: Range<usize>,
    is_kept: impl Fn(usize) -> bool,
    mut visit: impl FnMut(&[usize]),
) {
    let (mut block, mut count) = ([0; LANES], 0);
    for row in rows.filter(|row| is_kept(*row)) {
        block[count] = row;
        count += 1;
        if count == LANES {
            visit(&block);
            count = 0;
        }
    }
    if count > 0 {
        visit(&block[..count]);
    }
}
