//! When a run grows, and to how many Gaussians.

use super::ImprovedGsSettings;
use crate::strategy::{RunSchedule, StepInfo};

/// Refinements are not closer than this: their gradients are means over so many views.
const SHORTEST_INTERVAL: usize = 50;

/// The settings of growth, in steps of one run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Growth {
    pub(super) start: usize,
    pub(super) stop: usize,
    every: usize,
    /// From this step on the limit is open.
    full: usize,
    limit: usize,
}

impl Growth {
    pub(super) fn new(settings: &ImprovedGsSettings, run: &RunSchedule) -> Self {
        let stop = run.milestone(settings.stop);
        let start = run.start(settings.start).min(stop);
        let time = stop - start;
        let shortest = settings.every.min(SHORTEST_INTERVAL);
        Self {
            start,
            stop,
            every: (time / 10).clamp(shortest, settings.every),
            full: stop - settings.fill.min(time / 4),
            limit: settings.limit(),
        }
    }

    /// Whether gradients are measured in the step after so many.
    pub(super) fn measures(&self, step: usize) -> bool {
        (self.start..self.stop).contains(&step)
    }

    /// Which refinement is due after so many steps, counted from 1.
    pub(super) fn refinement(&self, step: usize) -> Option<usize> {
        let due = self.start < step && step < self.stop;
        (due && (step - self.start).is_multiple_of(self.every))
            .then(|| (step - self.start) / self.every)
    }

    /// Whether it is the last refinement.
    pub(super) fn is_last(&self, step: usize) -> bool {
        step + self.every >= self.stop
    }

    /// Whether growth fills what is left of the limit.
    pub(super) fn fills(&self, step: usize) -> bool {
        step > self.full
    }

    /// How many Gaussians there may be after so many steps: the square root of the share of time
    /// that has passed, of the limit.
    pub(super) fn budget(&self, step: usize) -> usize {
        if step >= self.full || self.limit == usize::MAX {
            return self.limit;
        }
        let time = (self.full - self.start) as f64;
        let passed = step.saturating_sub(self.start) as f64;
        ((passed / time).sqrt() * self.limit as f64) as usize
    }
}

/// Resets of opacities, and what follows them.
impl ImprovedGsSettings {
    /// Whether opacities are reset after so many steps.
    pub(super) fn resets(&self, at: &StepInfo) -> bool {
        let grows_on = at.step.saturating_add(self.recovery) < at.run.milestone(self.stop);
        at.step > 0 && at.step.is_multiple_of(self.reset_every) && grows_on
    }

    /// Whether what has not recovered from a reset is removed after so many steps.
    pub(super) fn prunes_unrecovered(&self, at: &StepInfo) -> bool {
        let Some(reset) = at.step.checked_sub(self.recovery) else {
            return false;
        };
        let numbered = reset / self.reset_every <= self.recovery_prunes;
        numbered && self.resets(&StepInfo { step: reset, ..*at })
    }

    /// Whether that was done since the refinement before this one.
    pub(super) fn has_pruned_unrecovered(&self, at: &StepInfo, growth: &Growth) -> bool {
        let before = at.step.saturating_sub(growth.every);
        (before..at.step).any(|step| self.prunes_unrecovered(&StepInfo { step, ..*at }))
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::at;
    use super::*;

    fn growth(steps: usize) -> Growth {
        let settings = ImprovedGsSettings::new().with_max_gaussians(1_000_000);
        Growth::new(&settings, &at(steps, 0).run)
    }

    fn refinements(steps: usize) -> Vec<usize> {
        let growth = growth(steps);
        let due = (0..steps).filter(|step| growth.refinement(*step).is_some());
        due.collect()
    }

    #[test]
    fn the_budget_is_the_square_root_of_the_time_and_then_all() {
        let growth = growth(30_000);
        assert_eq!(growth.budget(500), 0);
        // A quarter, and all, of the 14,000 steps.
        assert_eq!(growth.budget(4_000), 500_000);
        assert_eq!(growth.budget(14_500), 1_000_000);
        assert_eq!(growth.budget(14_900), 1_000_000);
        assert!(!growth.fills(14_500) && growth.fills(14_600));
    }

    #[test]
    fn a_long_run_refines_every_hundred_steps() {
        let steps = refinements(30_000);
        assert_eq!((steps[0], steps.len()), (600, 144));
        assert_eq!(steps.last(), Some(&14_900));
        let growth = growth(30_000);
        let last = steps.iter().filter(|step| growth.is_last(**step));
        assert_eq!(last.collect::<Vec<_>>(), [&14_900]);
    }

    /// At least as many refinements as the first Gaussians take to double to what is worthwhile,
    /// some of them with the whole budget.
    #[test]
    fn short_runs_refine_in_time_too() {
        for (steps, least) in [(1_000, 4), (2_000, 9), (3_000, 9), (7_000, 29)] {
            let due = refinements(steps);
            assert!(due.len() >= least, "{steps}: {due:?}");
            let growth = growth(steps);
            let full = due.iter().filter(|step| growth.budget(**step) == 1_000_000);
            assert!(full.count() >= 1, "{steps}: {due:?}");
            assert!(due.windows(2).all(|pair| pair[1] - pair[0] >= 50));
            assert!(due.iter().all(|step| *step < steps / 2));
        }
        assert!(refinements(10).is_empty());
    }

    #[test]
    fn resets_leave_time_to_recover() {
        let settings = ImprovedGsSettings::new();
        let steps = |of: usize, is: &dyn Fn(&StepInfo) -> bool| {
            let steps = (0..of).filter(|step| is(&at(of, *step)));
            steps.collect::<Vec<_>>()
        };
        let resets = |of| steps(of, &|at| settings.resets(at));
        let prunes = |of| steps(of, &|at| settings.prunes_unrecovered(at));
        assert_eq!(resets(30_000), [3_000, 6_000, 9_000, 12_000]);
        assert_eq!(prunes(30_000), [3_300, 6_300]);
        assert_eq!((resets(7_000), prunes(7_000)), (vec![3_000], vec![3_300]));
        assert_eq!((resets(6_400), prunes(6_400)), (vec![], vec![]));
        assert!(resets(2_000).is_empty());
        let run = growth(30_000);
        let all = |at: &StepInfo| {
            run.refinement(at.step).is_some() && settings.has_pruned_unrecovered(at, &run)
        };
        assert_eq!(steps(30_000, &all), [3_400, 6_400]);
    }
}
