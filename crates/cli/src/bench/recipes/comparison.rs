//! Means over seeds and captures, and the recipes against the first one.

use super::row::Row;
use super::statistics::{Mean, geometric};

/// Bytes of a megabyte.
const MEGABYTE: f64 = 1e6;

/// A recipe on a capture: means over the seeds.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct OnCapture<'a> {
    pub capture: &'a str,
    pub recipe: &'a str,
    /// Steps of a run.
    pub steps: usize,
    /// Number of seeds.
    pub seeds: usize,
    /// Held-out PSNR in dB.
    pub psnr: Mean,
    /// Held-out SSIM.
    pub ssim: Mean,
    pub gaussians: Mean,
    /// Seconds of training.
    pub seconds: Mean,
    /// Megabytes as SPZ.
    pub megabytes: Mean,
}

/// A recipe over all captures: means of the captures' means.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Overall<'a> {
    pub recipe: &'a str,
    /// Number of captures with a run.
    pub captures: usize,
    /// Held-out PSNR in dB.
    pub psnr: f64,
    /// Held-out SSIM.
    pub ssim: f64,
    pub gaussians: f64,
    /// Seconds of training.
    pub seconds: f64,
    /// Megabytes as SPZ.
    pub megabytes: f64,
    /// Compared with the first recipe, unless it is that, or no run has its counterpart.
    pub against: Option<Against>,
}

/// Runs compared with those of the first recipe on the same capture with the same seed.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Against {
    /// Number of pairs.
    pub pairs: usize,
    /// Difference of PSNR in dB.
    pub psnr: Mean,
    /// Ratio of Gaussians, like the others a geometric mean.
    pub gaussians: f64,
    /// Ratio of seconds of training.
    pub seconds: f64,
    /// Ratio of bytes as SPZ.
    pub bytes: f64,
}

/// Every recipe on every capture that has rows, in the order of the rows, where those of a recipe
/// on a capture follow each other.
pub(super) fn on_captures<'a>(rows: &[&'a Row]) -> Vec<OnCapture<'a>> {
    let same =
        |a: &&Row, b: &&Row| (&a.key.capture, &a.key.recipe) == (&b.key.capture, &b.key.recipe);
    rows.chunk_by(same)
        .filter_map(|rows| {
            let first = rows.first()?;
            let mean = |value: fn(&Row) -> f64| {
                Mean::of(&rows.iter().map(|row| value(row)).collect::<Vec<_>>())
            };
            Some(OnCapture {
                capture: &first.key.capture,
                recipe: &first.key.recipe,
                steps: first.key.steps,
                seeds: rows.len(),
                psnr: mean(|row| row.psnr),
                ssim: mean(|row| row.ssim),
                gaussians: mean(|row| row.gaussians as f64),
                seconds: mean(|row| row.seconds),
                megabytes: mean(|row| row.spz_bytes as f64 / MEGABYTE),
            })
        })
        .collect()
}

/// Every one of the recipes that has rows. All are compared with the first.
pub(super) fn overall<'a>(recipes: &[&'a str], rows: &[&Row]) -> Vec<Overall<'a>> {
    let on_captures = on_captures(rows);
    let base = recipes.first().copied().unwrap_or_default();
    let of_recipe = |&recipe: &&'a str| {
        let own: Vec<&OnCapture> = on_captures
            .iter()
            .filter(|one| one.recipe == recipe)
            .collect();
        let mean = |value: fn(&OnCapture) -> Mean| {
            own.iter().map(|one| value(one).mean).sum::<f64>() / own.len() as f64
        };
        (!own.is_empty()).then(|| Overall {
            recipe,
            captures: own.len(),
            psnr: mean(|one| one.psnr),
            ssim: mean(|one| one.ssim),
            gaussians: mean(|one| one.gaussians),
            seconds: mean(|one| one.seconds),
            megabytes: mean(|one| one.megabytes),
            against: against(recipe, base, rows),
        })
    };
    recipes.iter().filter_map(of_recipe).collect()
}

fn against(recipe: &str, base: &str, rows: &[&Row]) -> Option<Against> {
    let pairs = pairs(recipe, base, rows);
    if recipe == base || pairs.is_empty() {
        return None;
    }
    let each = |value: fn(&Row, &Row) -> f64| -> Vec<f64> {
        pairs.iter().map(|(row, base)| value(row, base)).collect()
    };
    let bytes = |row: &Row, base: &Row| row.spz_bytes as f64 / base.spz_bytes as f64;
    Some(Against {
        pairs: pairs.len(),
        psnr: Mean::of(&each(|row, base| row.psnr - base.psnr)),
        gaussians: geometric(&each(|row, base| {
            row.gaussians as f64 / base.gaussians as f64
        })),
        seconds: geometric(&each(|row, base| row.seconds / base.seconds)),
        bytes: geometric(&each(bytes)),
    })
}

/// Each run of a recipe with the run of another on the same capture with the same seed.
fn pairs<'a>(recipe: &str, base: &str, rows: &[&'a Row]) -> Vec<(&'a Row, &'a Row)> {
    let of_base = |row: &Row| {
        let same = |other: &&&'a Row| {
            other.key.recipe == base
                && other.key.capture == row.key.capture
                && other.key.seed == row.key.seed
        };
        rows.iter().find(same).copied()
    };
    rows.iter()
        .filter(|row| row.key.recipe == recipe)
        .filter_map(|row| Some((*row, of_base(row)?)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::row::example;
    use super::*;

    const BASE: &str = "default";

    /// Two captures of which the second has one seed of `mcmc` without a counterpart.
    fn rows() -> Vec<Row> {
        let mut rows = vec![
            example("a", BASE, 0, 20.0),
            example("a", BASE, 1, 21.0),
            example("a", "mcmc", 0, 21.0),
            example("a", "mcmc", 1, 23.0),
            example("b", BASE, 1, 30.0),
            example("b", "mcmc", 0, 99.0),
            example("b", "mcmc", 1, 30.0),
        ];
        for row in rows.iter_mut().filter(|row| row.key.recipe == "mcmc") {
            row.gaussians *= 2;
            row.seconds *= if row.key.capture == "a" { 4.0 } else { 1.0 };
            row.spz_bytes /= 2;
        }
        rows
    }

    #[test]
    fn seeds_are_averaged_by_capture_and_recipe() {
        let rows = rows();
        let means = on_captures(&rows.iter().collect::<Vec<_>>());
        let names: Vec<_> = means
            .iter()
            .map(|one| (one.capture, one.recipe, one.seeds))
            .collect();
        assert_eq!(
            names,
            [
                ("a", BASE, 2),
                ("a", "mcmc", 2),
                ("b", BASE, 1),
                ("b", "mcmc", 2)
            ]
        );
        assert_eq!(means[1].psnr.with(1).to_string(), "22.0 ± 1.0");
        assert_eq!(means[2].psnr.error, None);
        assert_eq!(means[0].megabytes.mean, 0.02);
    }

    #[test]
    fn recipes_are_compared_where_both_were_measured() {
        let rows = rows();
        let rows: Vec<&Row> = rows.iter().collect();
        let overall = overall(&[BASE, "fast", "mcmc"], &rows);
        assert_eq!(overall.len(), 2);
        assert_eq!((overall[0].recipe, overall[0].captures), (BASE, 2));
        assert_eq!(overall[0].psnr, 0.5 * (20.5 + 30.0));
        assert_eq!(overall[0].against, None);
        let against = overall[1].against.as_ref().unwrap();
        // 1, 2 and 0 dB; the run that has no counterpart does not count.
        assert_eq!((against.pairs, against.psnr.mean), (3, 1.0));
        let close = |a: f64, b: f64| (a - b).abs() < 1e-12;
        assert!(close(against.psnr.error.unwrap(), 1.0 / 3.0_f64.sqrt()));
        assert!(close(against.gaussians, 2.0) && close(against.bytes, 0.5));
        assert!(close(against.seconds, 16.0_f64.powf(1.0 / 3.0)));
    }

    #[test]
    fn without_the_default_nothing_is_compared() {
        let row = example("a", "mcmc", 0, 20.0);
        let overall = overall(&["mcmc"], &[&row]);
        assert_eq!(overall[0].against, None);
    }
}
