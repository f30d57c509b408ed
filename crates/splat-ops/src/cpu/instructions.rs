//! Selection of the processor's instruction set for the inner loops.

use core::fmt;
use core::sync::atomic::{AtomicU8, Ordering};

use macerator::Arch;

/// An instruction set that the loops are compiled for; better ones compare greater.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum InstructionSet {
    /// The baseline of the target; the rasteriser uses SSE 4.2 if available.
    Baseline,
    /// 64-bit Arm, where it is the baseline.
    Neon,
    /// x86-64 with AVX2 and FMA.
    Avx2,
    /// x86-64 with AVX-512 F, BW, DQ and VL.
    Avx512,
}

/// The best set allowed to run; all by default.
static MOST: AtomicU8 = AtomicU8::new(InstructionSet::Avx512 as u8);

impl InstructionSet {
    /// Sets that this processor supports, best first.
    pub fn available() -> Vec<Self> {
        match Self::of(Arch::detect()) {
            Self::Avx512 => vec![Self::Avx512, Self::Avx2, Self::Baseline],
            Self::Avx2 => vec![Self::Avx2, Self::Baseline],
            only => vec![only],
        }
    }

    /// The set in use.
    #[inline]
    pub fn chosen() -> Self {
        Self::of(registers())
    }

    /// Calls `run` with this set, or the best supported one below it, for measuring and comparing.
    /// Applies to the whole process until it returns.
    pub fn at_most<R>(self, run: impl FnOnce() -> R) -> R {
        struct Restored(u8);
        impl Drop for Restored {
            fn drop(&mut self) {
                MOST.store(self.0, Ordering::Relaxed);
            }
        }
        let _restored = Restored(MOST.swap(self as u8, Ordering::Relaxed));
        run()
    }

    fn of(registers: Arch) -> Self {
        match registers {
            #[cfg(target_arch = "x86_64")]
            Arch::V4 => Self::Avx512,
            #[cfg(target_arch = "x86_64")]
            Arch::V3 => Self::Avx2,
            #[cfg(target_arch = "aarch64")]
            Arch::NeonFma | Arch::NeonF16 => Self::Neon,
            _ => Self::Baseline,
        }
    }
}

/// Registers of the set in use, which the processor supports.
#[inline]
pub(super) fn registers() -> Arch {
    let best = Arch::detect();
    #[cfg(target_arch = "x86_64")]
    {
        let most = MOST.load(Ordering::Relaxed);
        if most < InstructionSet::of(best) as u8 {
            // AVX-512 implies AVX2 and everything before it.
            return match most < InstructionSet::Avx2 as u8 {
                true => Arch::V2,
                false => Arch::V3,
            };
        }
    }
    best
}

impl fmt::Display for InstructionSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Avx512 => "AVX-512",
            Self::Avx2 => "AVX2 and FMA",
            Self::Neon => "NEON",
            Self::Baseline => "baseline",
        })
    }
}
