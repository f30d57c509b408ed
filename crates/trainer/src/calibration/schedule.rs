//! When cameras are refined.

use super::CalibrationSettings;

/// The steps of a run in which cameras are refined, from [`CalibrationSettings::schedule`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CalibrationSchedule {
    /// Cameras are refined from this step on.
    pub start: usize,
    /// Steps of the run.
    pub steps: usize,
    /// What is left of all rates at the end.
    pub final_share: f64,
}

impl CalibrationSettings {
    /// The schedule of a run of this many steps that trains on so many views, some in each step.
    pub fn schedule(
        &self,
        steps: usize,
        views: usize,
        views_per_step: usize,
    ) -> CalibrationSchedule {
        let pass = views.div_ceil(views_per_step.max(1));
        CalibrationSchedule {
            start: self.start_passes.saturating_mul(pass).min(steps / 8),
            steps,
            final_share: self.final_share,
        }
    }
}

impl CalibrationSchedule {
    /// The factor of all rates at a step, if cameras are refined in it.
    pub fn factor(&self, step: usize) -> Option<f64> {
        let steps = self.steps.saturating_sub(self.start).max(1);
        let done = step.checked_sub(self.start)?;
        Some(self.final_share.powf(done as f64 / steps as f64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_move_after_some_passes() {
        let settings = CalibrationSettings::new().with_start_passes(10);
        let schedule = settings.schedule(10_000, 43, 1);
        assert_eq!(schedule.start, 430);
        assert_eq!(schedule.factor(429), None);
        assert_eq!(schedule.factor(430), Some(1.0));
        let last = schedule.factor(9_999).unwrap();
        assert!((last / 0.01 - 1.0).abs() < 1e-3, "{last}");
        // Short runs, and several views a step.
        assert_eq!(settings.schedule(80, 43, 1).start, 10);
        assert_eq!(settings.schedule(10_000, 43, 4).start, 110);
        assert_eq!(settings.schedule(0, 43, 4).factor(0), Some(1.0));
    }
}
