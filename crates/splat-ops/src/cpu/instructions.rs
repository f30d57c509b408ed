//! Which of the processor's instructions the inner loops use.

use core::fmt;
use core::sync::atomic::{AtomicU8, Ordering};

use macerator::Arch;

/// A set of instructions that the loops are compiled for; a better one is greater.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum InstructionSet {
    /// The instructions of every processor of the target; the rasteriser uses SSE 4.2 where there
    /// is that.
    Baseline,
    /// 64-bit Arm, whose baseline has them.
    Neon,
    /// x86-64 with AVX2 and FMA.
    Avx2,
    /// x86-64 with AVX-512 F, BW, DQ and VL.
    Avx512,
}

/// The most that may run; all of them.
static MOST: AtomicU8 = AtomicU8::new(InstructionSet::Avx512 as u8);

impl InstructionSet {
    /// Those that this processor runs, the best one first.
    pub fn available() -> Vec<Self> {
        match Self::of(Arch::detect()) {
            Self::Avx512 => vec![Self::Avx512, Self::Avx2, Self::Baseline],
            Self::Avx2 => vec![Self::Avx2, Self::Baseline],
            only => vec![only],
        }
    }

    /// The one that runs.
    #[inline]
    pub fn chosen() -> Self {
        Self::of(registers())
    }

    /// Does something with a set, or the best one that is no better, in place of the best one: to
    /// measure and to compare. Holds for the whole process, until this returns.
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

/// The registers of the set that runs. The processor has them.
#[inline]
pub(super) fn registers() -> Arch {
    let best = Arch::detect();
    #[cfg(target_arch = "x86_64")]
    {
        let most = MOST.load(Ordering::Relaxed);
        if most < InstructionSet::of(best) as u8 {
            // A processor with AVX-512 has AVX2, and all that came before.
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
