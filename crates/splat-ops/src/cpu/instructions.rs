//! Which of the processor's instructions the inner loops use.

use core::fmt;

/// A set of instructions that the loops are compiled for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InstructionSet {
    /// x86-64 with AVX2 and FMA.
    Avx2,
    /// 64-bit Arm, whose baseline has them.
    Neon,
    /// What every processor of the target has.
    Baseline,
}

impl InstructionSet {
    /// The one that runs on this processor; `simd.rs` chooses by the same features.
    pub fn chosen() -> Self {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            return Self::Avx2;
        }
        if cfg!(target_arch = "aarch64") {
            Self::Neon
        } else {
            Self::Baseline
        }
    }
}

impl fmt::Display for InstructionSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Avx2 => "AVX2 and FMA",
            Self::Neon => "NEON",
            Self::Baseline => "baseline",
        })
    }
}
