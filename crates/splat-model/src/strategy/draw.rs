//! Random draws of strategies, each from (seed, step, id) alone.

use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;

use super::StepInfo;

fn generator(at: &StepInfo, id: u64) -> Pcg64Mcg {
    let seed = at.run.seed ^ (at.step as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    Pcg64Mcg::seed_from_u64(seed ^ id.wrapping_mul(0xD1B5_4A32_D192_ED03))
}

/// Three standard normal draws.
pub(super) fn normals(at: &StepInfo, id: u64) -> [f64; 3] {
    let mut rng = generator(at, id);
    // Drawn in single precision, as always: other draws would make other scenes.
    [(); 3].map(|()| f64::from(Distribution::<f32>::sample(&StandardNormal, &mut rng)))
}

/// A draw from [0, 1).
pub(super) fn uniform(at: &StepInfo, id: u64) -> f64 {
    generator(at, id).random()
}
