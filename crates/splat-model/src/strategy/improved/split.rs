//! The long-axis split (Deng et al. 2025, *Improving Densification in 3D Gaussian Splatting*).

use super::super::splats::Splats;
use crate::opacity::{logit, sigmoid};

/// By this share the longest axis shrinks.
const SHARE: f64 = 0.45;
/// Opacity of a half, in opacities of its parent.
const OPACITY: f64 = 0.6;

/// The two halves of a Gaussian, in terms of it. Rotation and colour are its own.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Halves {
    /// From the mean of the parent to those of the halves.
    pub(super) offsets: [[f64; 3]; 2],
    /// Added to the log-scales.
    pub(super) log_scales: [f64; 3],
    /// Opacity of each half, as a logit.
    pub(super) opacity_logit: f64,
}

/// Splits a Gaussian across its longest axis L, of standard deviation `s_L`:
///
/// ```text
/// μ' = μ ± 3 · 0.45 s_L,  s_L' = (1 - 0.45) s_L,  s_other' = √(1 - 0.45²) s_other,  o' = 0.6 o
/// ```
///
/// Along L the halves reach as far as three standard deviations of the parent, and no further; the
/// other axes are as long as the section of the parent's ellipsoid at 0.45 of its half axis.
pub(super) fn long_axis_split(splats: &Splats, row: usize) -> Halves {
    let scales = splats.log_scales[row];
    let longest = (0..3).fold(0, |best, axis| match scales[axis] > scales[best] {
        true => axis,
        false => best,
    });
    let mut along = [0.0; 3];
    along[longest] = 3.0 * SHARE;
    let offset = splats.offset(row, along);
    let mut log_scales = [(1.0 - SHARE * SHARE).ln() / 2.0; 3];
    log_scales[longest] = (1.0 - SHARE).ln();
    let shared = logit(OPACITY * sigmoid(splats.opacity_logits[row]));
    Halves {
        offsets: [offset, offset.map(|x| -x)],
        log_scales,
        // An opacity of zero has no logit to halve.
        opacity_logit: match shared.is_finite() {
            true => shared,
            false => splats.opacity_logits[row],
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A quarter turn about z puts the x axis, the longest, along y.
    fn splats() -> Splats {
        let half = core::f64::consts::FRAC_1_SQRT_2;
        Splats {
            means: vec![[0.0; 3]],
            log_scales: vec![[2.0f64, 0.5, 1.0].map(f64::ln)],
            quats: vec![[3.0 * half, 0.0, 0.0, 3.0 * half]],
            opacity_logits: vec![logit(0.8)],
        }
    }

    #[test]
    fn halves_lie_along_the_longest_axis_and_end_where_the_parent_does() {
        let halves = long_axis_split(&splats(), 0);
        let [first, second] = halves.offsets;
        assert!((first[1] - 2.7).abs() < 1e-12 && first[0].abs() < 1e-12 && first[2] == 0.0);
        assert_eq!(second, first.map(|x| -x));
        let [x, y, z] = halves.log_scales.map(f64::exp);
        assert!((x - 0.55).abs() < 1e-12);
        assert!((y - 0.893_028_554_974_9).abs() < 1e-9 && y == z);
        // Three standard deviations of the half from its mean, and of the parent from its own.
        assert!((first[1] + 3.0 * 2.0 * x - 3.0 * 2.0).abs() < 1e-12);
        assert!((sigmoid(halves.opacity_logit) - 0.48).abs() < 1e-12);
    }

    #[test]
    fn opaque_and_transparent_ones_stay_finite() {
        let mut splats = splats();
        for (parent, half) in [(f64::INFINITY, 0.6), (40.0, 0.6), (-900.0, 0.0)] {
            splats.opacity_logits[0] = parent;
            let logit = long_axis_split(&splats, 0).opacity_logit;
            assert!(logit.is_finite() && (sigmoid(logit) - half).abs() < 1e-9);
        }
        splats.quats[0] = [0.0; 4];
        assert_eq!(long_axis_split(&splats, 0).offsets, [[0.0; 3]; 2]);
    }
}
