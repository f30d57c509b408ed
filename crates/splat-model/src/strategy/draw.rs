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

/// Draws up to `count` of the candidates, each a row and its weight, without replacement and each
/// time with a probability proportional to the weight; returns the rows in ascending order. What
/// has no weight is never drawn. `uniform` gives each row a draw from [0, 1).
///
/// Those with the smallest of the keys `-ln(u) / w` are such a draw (Efraimidis & Spirakis 2006,
/// *Weighted random sampling with a reservoir*). A key is of one row alone, so that the draw does
/// not depend on the order of rows or threads.
pub(super) fn without_replacement(
    candidates: &[(usize, f64)],
    count: usize,
    uniform: impl Fn(usize) -> f64,
) -> Vec<usize> {
    let mut keys: Vec<(f64, usize)> = (candidates.iter())
        .filter(|(_, weight)| *weight > 0.0)
        // 1 - u lies in (0, 1], of which the logarithm is finite.
        .map(|(row, weight)| (-(-uniform(*row)).ln_1p() / weight, *row))
        .collect();
    if keys.len() > count {
        keys.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        keys.truncate(count);
    }
    let mut rows: Vec<usize> = keys.into_iter().map(|(_, row)| row).collect();
    rows.sort_unstable();
    rows
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::strategy::RunSchedule;

    fn at(step: usize) -> StepInfo {
        let run = RunSchedule {
            steps: 30_000,
            scene_scale: splat_data::SceneScale::new(1.0).unwrap(),
            seed: 1,
        };
        StepInfo { step, run }
    }

    /// Draws of one of two, and of two of three, as often as their weights say.
    #[test]
    fn rows_are_drawn_as_often_as_their_weights_say() {
        const TIMES: usize = 10_000;
        let often = |candidates: &[(usize, f64)], count: usize, row: usize| {
            let drawn = (0..TIMES).filter(|step| {
                let at = at(*step);
                let rows = without_replacement(candidates, count, |id| uniform(&at, id as u64));
                assert_eq!(rows.len(), count);
                rows.contains(&row)
            });
            drawn.count() as f64 / TIMES as f64
        };
        // Five standard errors of a share of ten thousand draws are at most 0.025.
        let near = |share: f64, expected: f64| (share - expected).abs() < 0.025;
        assert!(near(often(&[(4, 3.0), (9, 1.0)], 1, 4), 0.75));
        // The first draw takes row 0 in half of all cases; the second what is left by its weight:
        // 1/2 + 1/4 * 2/3 * 2 = 5/6.
        let three = [(0, 2.0), (1, 1.0), (2, 1.0)];
        assert!(near(often(&three, 2, 0), 5.0 / 6.0));
        assert!(near(often(&three, 2, 1), 7.0 / 12.0));
    }

    #[test]
    fn what_has_no_weight_is_never_drawn_and_nothing_twice() {
        let candidates = [
            (7, 1.0),
            (3, f64::NAN),
            (1, 0.0),
            (5, f64::INFINITY),
            (2, 1e-9),
        ];
        let draw = |id: usize| uniform(&at(600), id as u64);
        assert_eq!(without_replacement(&candidates, 9, draw), [2, 5, 7]);
        assert_eq!(without_replacement(&candidates, 1, draw), [5]);
        assert!(without_replacement(&candidates, 0, draw).is_empty());
    }

    #[test]
    fn the_draw_repeats_in_any_order_of_candidates() {
        let candidates: Vec<(usize, f64)> = (0..50).map(|row| (row, 1.0 + row as f64)).collect();
        let reversed: Vec<_> = candidates.iter().rev().copied().collect();
        let draw = |id: usize| uniform(&at(600), id as u64);
        let rows = without_replacement(&candidates, 20, draw);
        assert_eq!(rows, without_replacement(&reversed, 20, draw));
        let other = |id: usize| uniform(&at(700), id as u64);
        assert_ne!(rows, without_replacement(&candidates, 20, other));
    }
}
