//! Which of the processor's instructions the inner loops use.

use core::fmt;

use macerator::Arch;

/// A set of instructions that the loops are compiled for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InstructionSet {
    /// x86-64 with AVX-512 F, BW, DQ and VL.
    Avx512,
    /// x86-64 with AVX2 and FMA.
    Avx2,
    /// 64-bit Arm, whose baseline has them.
    Neon,
    /// What every processor of the target has; the rasteriser uses SSE 4.2 where there is that.
    Baseline,
}

impl InstructionSet {
    /// The one that runs on this processor.
    #[inline]
    pub fn chosen() -> Self {
        match Arch::detect() {
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
