//! Checks of the losses, after every quarter of a run.

use super::Warning;
use crate::quantile::median;
use crate::train::LossRecord;

/// Smallest number of losses by which a view is judged; the median of fewer may be a single bad
/// step.
const VISITS: usize = 3;
/// Smallest number of views that are compared; among fewer, none is typical.
const COMPARABLE: usize = 4;
/// Multiple of the usual loss from which a view is hard, if it also exceeds [`HARD_SPREAD`] and has
/// not fallen below [`STAYS`]. Views that are merely harder than others reach 2.0, but their loss
/// falls.
const HARD: f64 = 1.75;
/// Distance of a hard view from the usual one, in median deviations of the views' losses.
const HARD_SPREAD: f64 = 8.0;
/// Multiple of its minimum from which the loss is rising. Rows that were just split raise it by
/// 1.35 for some steps.
const RISES: f64 = 1.5;
/// Share of the first loss above which it has not fallen; in a real capture it halves in a few
/// hundred steps.
const STAYS: f64 = 0.9;
/// Smallest number of losses that are compared at each time.
const STEPS: usize = 25;

/// The losses of a run up to a step.
pub(in crate::train) struct Course<'a> {
    /// Every step whose loss was finite, in order.
    pub losses: &'a [LossRecord],
    /// Steps done.
    pub step: usize,
    /// Steps of the whole run.
    pub steps: usize,
}

/// True if a run is checked after this step.
pub(in crate::train) fn is_due(step: usize, steps: usize) -> bool {
    step == steps || (1..4).any(|quarter| step == steps * quarter / 4)
}

impl Course<'_> {
    /// All warnings about the losses. `view_at` returns the view of a step (from 0), as an index
    /// below `views`; `name` gives its photo. With 0 views none is judged.
    pub(in crate::train) fn inspect(
        &self,
        views: usize,
        view_at: impl FnMut(usize) -> usize,
        name: impl Fn(usize) -> String,
    ) -> Vec<Warning> {
        let mut warnings = Vec::new();
        warnings.extend(self.hard_views(views, view_at, name));
        warnings.extend(self.rises().or_else(|| self.does_not_fall()));
        warnings
    }

    /// Losses of the steps in (from, to].
    fn between(&self, from: usize, to: usize) -> &[LossRecord] {
        let index = |step| self.losses.partition_point(|record| record.step <= step);
        &self.losses[index(from)..index(to)]
    }

    /// Median loss of the steps in (from, to]; `None` if there are too few.
    fn level(&self, from: usize, to: usize) -> Option<f64> {
        let losses = self.between(from, to);
        (losses.len() >= STEPS).then(|| median(losses.iter().map(total)))
    }

    /// Uses the later half of the steps so far, as views that were visited early have fallen less.
    fn hard_views(
        &self,
        views: usize,
        mut view_at: impl FnMut(usize) -> usize,
        name: impl Fn(usize) -> String,
    ) -> Option<Warning> {
        if views == 0 {
            return None;
        }
        let mut losses = vec![Vec::new(); views];
        for record in self.between(self.step / 2, self.step) {
            losses[view_at(record.step - 1)].push(total(record));
        }
        let levels: Vec<(usize, f64)> = losses
            .into_iter()
            .enumerate()
            .filter(|(_, losses)| losses.len() >= VISITS)
            .map(|(view, losses)| (view, median(losses)))
            .collect();
        if levels.len() < COMPARABLE {
            return None;
        }
        let usual = median(levels.iter().map(|(_, level)| *level));
        let spread = median(levels.iter().map(|(_, level)| (level - usual).abs()));
        let hard: Vec<_> = levels
            .iter()
            .filter(|(_, level)| *level > (HARD * usual).max(usual + HARD_SPREAD * spread))
            .filter(|(view, level)| {
                let first = self.losses.iter().find(|r| view_at(r.step - 1) == *view);
                first.is_some_and(|first| *level > STAYS * total(first))
            })
            .collect();
        Some(Warning::HardViews {
            loss: hard.first()?.1,
            views: hard.iter().map(|(view, _)| name(*view)).collect(),
            step: self.step,
            usual,
        })
    }

    fn rises(&self) -> Option<Warning> {
        let quarters = [0, 1, 2, 3, 4].map(|quarter| self.steps * quarter / 4);
        let done = quarters.iter().filter(|end| **end <= self.step).count();
        let levels: Vec<f64> = quarters[..done]
            .windows(2)
            .filter_map(|quarter| self.level(quarter[0], quarter[1]))
            .collect();
        let (loss, before) = levels.split_last()?;
        let least = before.iter().copied().reduce(f64::min)?;
        (*loss > RISES * least).then_some(Warning::LossRises {
            step: self.step,
            loss: *loss,
            least,
        })
    }

    /// Judged at the end only.
    fn does_not_fall(&self) -> Option<Warning> {
        if self.step < self.steps || self.steps < 4 * STEPS {
            return None;
        }
        let first = self.level(0, STEPS)?;
        let last = self.level(self.steps * 3 / 4, self.steps)?;
        (last > STAYS * first).then_some(Warning::LossDoesNotFall {
            step: self.step,
            first,
            last,
        })
    }
}

fn total(record: &LossRecord) -> f64 {
    record.total.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEPS: usize = 400;
    const VIEWS: usize = 10;

    /// Warnings at the end of a run in which step `step` (from 0) had a given loss.
    fn found(loss: impl Fn(usize) -> f32) -> Vec<Warning> {
        let losses: Vec<LossRecord> = (0..STEPS)
            .map(|step| LossRecord {
                step: step + 1,
                total: loss(step),
                terms: Vec::new(),
            })
            .collect();
        let course = Course {
            losses: &losses,
            step: STEPS,
            steps: STEPS,
        };
        course.inspect(VIEWS, |step| step % VIEWS, |view| format!("{view}.png"))
    }

    fn falling(step: usize) -> f32 {
        0.1 + 0.3 * (-(step as f32) / 50.0).exp()
    }

    #[test]
    fn a_falling_loss_and_one_spike_are_well() {
        assert_eq!(found(falling), []);
        assert_eq!(
            found(|step| if step == 390 { 9.0 } else { falling(step) }),
            []
        );
    }

    #[test]
    fn the_view_whose_loss_stays_high_is_named() {
        let one_high = |step| {
            if step % VIEWS == 7 {
                0.3
            } else {
                falling(step)
            }
        };
        let warnings = found(one_high);
        assert!(
            matches!(&warnings[..], [Warning::HardViews { views, .. }] if views == &["7.png"]),
            "{warnings:?}"
        );
    }

    #[test]
    fn a_view_whose_loss_falls_is_not_hard() {
        let harder = |step| falling(step) * if step % VIEWS == 7 { 3.0 } else { 1.0 };
        assert_eq!(found(harder), []);
    }

    #[test]
    fn where_views_differ_much_none_is_hard() {
        let spread = |step| falling(step) * (1.0 + (step % VIEWS) as f32 / 5.0);
        assert_eq!(found(spread), []);
    }

    #[test]
    fn a_loss_that_rises_or_stays_is_told_apart() {
        let rising = |step| if step > 300 { 0.4 } else { falling(step) };
        assert!(matches!(found(rising)[..], [Warning::LossRises { .. }]));
        assert!(matches!(
            found(|_| 0.3)[..],
            [Warning::LossDoesNotFall { .. }]
        ));
    }

    #[test]
    fn every_quarter_is_due_once() {
        for steps in [1, 2, 3, 7, 400] {
            let due = (1..=steps).filter(|step| is_due(*step, steps)).count();
            assert_eq!(due, steps.min(4), "{steps} steps");
        }
    }
}
