//! Facts about a run that its strategy needs.

use splat_data::SceneScale;

/// The run length that milestones are stated for.
const REFERENCE_STEPS: f64 = 30_000.0;

/// Length, scene size and seed of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RunSchedule {
    /// Steps of the whole run.
    pub steps: usize,
    /// Size of the scene.
    pub scene_scale: SceneScale,
    /// Seed of the run.
    pub seed: u64,
}

/// A step of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepInfo {
    /// The step, counted from 0.
    pub step: usize,
    /// The run that it is of.
    pub run: RunSchedule,
}

impl RunSchedule {
    /// A milestone of a run of 30,000 steps in this run, at least 1. Longer runs keep it.
    pub fn milestone(&self, step: usize) -> usize {
        let share = (self.steps as f64 / REFERENCE_STEPS).min(1.0);
        ((step as f64 * share).round() as usize).max(1)
    }

    /// The step after which Gaussians may be added: this one, or a quarter of the run where that is
    /// sooner.
    pub(super) fn start(&self, step: usize) -> usize {
        step.min(self.steps / 4)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn milestones_shrink_with_the_run() {
        let run = |steps| RunSchedule {
            steps,
            scene_scale: SceneScale::new(2.0).unwrap(),
            seed: 1,
        };
        assert_eq!(run(3_000).milestone(15_000), 1_500);
        assert_eq!(run(60_000).milestone(500), 500);
        assert_eq!(run(10).milestone(500), 1);
    }
}
