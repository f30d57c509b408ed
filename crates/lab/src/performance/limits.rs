//! Reference speeds of the rasteriser's inner loops, with nothing else in their way.

use splat_ops::cpu::InstructionSet;

/// 1e9 evaluations per second and core.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Limit {
    /// Measured speed of the inner loop's arithmetic on a machine with AVX-512: a tile of 16 x 16
    /// pixels with 256 splats, in cache, forward and backward. Not all values were measured.
    pub reached: [Option<f64>; 2],
    /// Goals of the rasteriser, forward and backward.
    pub goal: Option<[f64; 2]>,
}

pub(super) const AVX512: Limit = Limit {
    reached: [Some(3.6), Some(1.2)],
    goal: Some([2.5, 0.8]),
};

pub(super) const AVX2: Limit = Limit {
    reached: [Some(2.0), None],
    goal: Some([1.4, 0.5]),
};

const BASELINE: Limit = Limit {
    reached: [None; 2],
    goal: None,
};

/// Speed of scalar code with libm, forward.
pub(super) const SCALAR: f64 = 0.1;

/// Limit of the running instruction set. None was measured for NEON, whose vectors are half of
/// AVX2's; it is compared with AVX2.
pub(super) fn limit(instructions: InstructionSet) -> Limit {
    match instructions {
        InstructionSet::Avx512 => AVX512,
        InstructionSet::Avx2 | InstructionSet::Neon => AVX2,
        InstructionSet::Baseline => BASELINE,
    }
}
