//! Splitting a Gaussian into copies that together look like it (Kheradmand et al. 2024, *3D
//! Gaussian Splatting as Markov Chain Monte Carlo*, section 3).

use core::f64::consts::PI;
use core::ops::RangeInclusive;

use crate::opacity::{logit, sigmoid};

/// Opacity of each of `copies` Gaussians in one place that replace one of `opacity`, and the factor
/// of their scales.
///
/// ```text
/// o' = 1 - (1 - o)^(1/N)
/// s' = s o / Σ_{i=1..N} Σ_{k=0..i-1} C(i-1, k) (-1)^k o'^(k+1) / √(k+1)
/// ```
///
/// The alternating sum loses every digit from N of about 40 on. It is the integral of a function
/// that is never negative, `∫ 1 - (1 - o' exp(-x²))^N dx / √π`, and is taken as that; the
/// trapezoidal rule on it converges geometrically. Opacities outside [0, 1] are clamped; no copies
/// at all count as one.
///
/// ```
/// let (opacity, factor) = splat_model::strategy::relocate(0.75, 2);
/// assert!((opacity - 0.5).abs() < 1e-12 && 0.8 < factor && factor < 1.0);
/// ```
pub fn relocate(opacity: f64, copies: usize) -> (f64, f64) {
    let opacity = opacity.clamp(0.0, 1.0);
    // Neither end cancels: ln(1 - o) and e^x - 1 are taken as functions of their own.
    let shared = -((-opacity).ln_1p() / copies.max(1) as f64).exp_m1();
    (shared, scale_factor(opacity, shared, copies))
}

/// The same in terms of logits, with o' kept within bounds, of which the scale then follows: the
/// logit of o', and the factor of the scales. An opacity next to one loses its digits, its logit
/// does not.
pub(super) fn relocate_logit(
    logit: f64,
    copies: usize,
    bounds: &RangeInclusive<f64>,
) -> (f64, f64) {
    // ln(1 - o) and that of each copy.
    let shade = -(logit.max(0.0) + (-logit.abs()).exp().ln_1p());
    let each = shade / copies.max(1) as f64;
    let shared = -each.exp_m1();
    let (shared, logit_of_each) = match shared {
        low if low < *bounds.start() => (*bounds.start(), self::logit(*bounds.start())),
        high if high > *bounds.end() => (*bounds.end(), self::logit(*bounds.end())),
        shared => (shared, shared.ln() - each),
    };
    let factor = scale_factor(sigmoid(logit), shared, copies);
    (logit_of_each, factor)
}

/// `s' / s`, given the opacity of the one, and that of each copy.
fn scale_factor(opacity: f64, shared: f64, copies: usize) -> f64 {
    match opacity == 0.0 || shared == 0.0 {
        true => 1.0,
        false => opacity / together(shared, copies.max(1) as f64),
    }
}

/// `∫ 1 - (1 - o exp(-x²))^n dx / √π`.
fn together(opacity: f64, n: f64) -> f64 {
    /// The integrand is below 1e-16 beyond this for up to a million copies.
    const END: f64 = 7.2;
    const STEPS: usize = 288;
    let step = END / STEPS as f64;
    let covered = |x: f64| -(n * (-opacity * (-x * x).exp()).ln_1p()).exp_m1();
    // Even: twice the positive half.
    let half: f64 = (1..=STEPS).map(|i| covered(i as f64 * step)).sum();
    (2.0 * half + covered(0.0)) * step / PI.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The sum as the paper has it.
    fn series(opacity: f64, copies: usize) -> f64 {
        let mut sum = 0.0;
        for i in 1..=copies {
            let mut binomial = 1.0;
            for k in 0..i {
                let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
                let power = opacity.powi(k as i32 + 1);
                sum += sign * binomial * power / ((k + 1) as f64).sqrt();
                binomial *= (i - 1 - k) as f64 / (k + 1) as f64;
            }
        }
        sum
    }

    #[test]
    fn few_copies_agree_with_the_series() {
        for copies in 1..=8 {
            for opacity in [1e-6, 0.004, 0.3, 0.9, 0.9999, 1.0] {
                let (shared, factor) = relocate(opacity, copies);
                let exact = 1.0 - (1.0 - opacity).powf(1.0 / copies as f64);
                assert!((shared - exact).abs() <= 1e-12, "{opacity} {copies}");
                let expected = opacity / series(shared, copies);
                let error = (factor / expected - 1.0).abs();
                assert!(error < 1e-11, "{opacity} {copies}: {error:e}");
            }
        }
    }

    /// Opacity, that of each of 51 copies, and the factor of their scales.
    const FIFTY_ONE: [(f64, f64, f64); 5] = [
        (0.05, 0.0010052452724535741, 0.9926828933818265),
        (0.5, 0.013499178904123412, 0.90904855575407),
        (0.99, 0.08634062736082236, 0.6421244069737003),
        (0.9999990463256836, 0.23801043967405833, 0.5150331898184646),
        (1.0, 1.0, 0.42077837140354113),
    ];

    /// Against the series in decimal arithmetic of 90 digits.
    #[test]
    fn fifty_one_copies_keep_their_digits() {
        for (opacity, shared, factor) in FIFTY_ONE {
            let (s, f) = relocate(opacity, 51);
            assert!((s / shared - 1.0).abs() < 1e-12, "{opacity}: {s:e}");
            assert!((f / factor - 1.0).abs() < 1e-12, "{opacity}: {f:e}");
        }
    }

    /// Against Python's decimal arithmetic (`tests/fixtures/relocation.py`), with gsplat's bounds
    /// and without, at opacities from 0.005 to one less 1e-13, for up to a thousand copies.
    #[test]
    fn relocation_agrees_with_decimal_arithmetic() {
        let file = splat_test_support::Reference::read("strategies/relocation_formula");
        let most = file.number("most_copies") as usize;
        let logits = file.values("opacity_logits");
        let bounds = [
            (
                "clamped",
                file.number("min_opacity")..=1.0 - f64::from(f32::EPSILON),
            ),
            ("unclamped", 0.0..=1.0),
        ];
        for (prefix, bounds) in bounds {
            let ours = logits.iter().zip(file.indices("copies"));
            let ours = ours.map(|(logit, n)| relocate_logit(*logit, n.min(most), &bounds));
            let (ours, factors): (Vec<f64>, Vec<f64>) = ours.unzip();
            for (name, ours) in [("opacity_logits", ours), ("scale_factors", factors)] {
                let expected = file.values(&format!("{prefix}.{name}"));
                for (ours, expected) in ours.iter().zip(expected) {
                    let error = (ours - expected).abs() / expected.abs().max(1.0);
                    assert!(
                        error < 1e-11,
                        "{prefix} {name}: {ours} instead of {expected}"
                    );
                }
            }
        }
    }

    #[test]
    fn nothing_is_not_a_number() {
        for opacity in [-1.0, 0.0, 1e-300, 1.0 - 1e-16, 1.0, 2.0] {
            for copies in [0, 1, 51, 1_000_000] {
                let (shared, factor) = relocate(opacity, copies);
                assert!((0.0..=1.0).contains(&shared), "{opacity} {copies}");
                assert!(
                    factor > 0.0 && factor <= 1.0 + 1e-12,
                    "{opacity} {copies}: {factor}"
                );
            }
        }
    }
}
