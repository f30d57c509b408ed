//! Degree of the spherical harmonics over a run (3DGS section 7.1: one more every thousand
//! iterations).

use splat_model::strategy::StepInfo;
use splat_ops::SH_DEGREE_MAX;

use super::TrainSettings;

/// The degree at a step of a run on so many photos.
///
/// Steps per degree shrink with the run as milestones do, down to one pass over the photos, so that
/// every photo has had its say in the coefficients of a degree before the next; and they are never
/// more than the settings say.
pub(super) fn degree(config: &TrainSettings, at: &StepInfo, photos: usize) -> usize {
    let stated = config.sh_degree_every;
    let pass = photos.div_ceil(config.views_per_step.max(1));
    let every = at.run.milestone(stated).max(pass.min(stated));
    (at.step / every).min(SH_DEGREE_MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_model::SceneScale;
    use splat_model::strategy::RunSchedule;

    /// The first steps of degrees 1 to 3.
    fn first_steps(steps: usize, photos: usize, config: &TrainSettings) -> Vec<usize> {
        let run = RunSchedule {
            steps,
            scene_scale: SceneScale::new(1.0).unwrap(),
            seed: 0,
        };
        let degree = |step| degree(config, &StepInfo { step, run }, photos);
        let rises = (1..steps).filter(|step| degree(*step) > degree(step - 1));
        rises.collect()
    }

    #[test]
    fn a_degree_lasts_a_pass_over_the_photos_however_short_the_run() {
        let config = TrainSettings::default();
        assert_eq!(first_steps(300, 28, &config), [28, 56, 84]);
        assert_eq!(first_steps(70, 28, &config), [28, 56]);
        // Where the run leaves more time than that, it is as it was.
        assert_eq!(first_steps(1_000, 28, &config), [33, 66, 99]);
        assert_eq!(first_steps(30_000, 28, &config), [1_000, 2_000, 3_000]);
    }

    #[test]
    fn many_photos_delay_no_degree_beyond_what_is_stated() {
        let config = TrainSettings::default();
        assert_eq!(first_steps(7_000, 2_000, &config), [1_000, 2_000, 3_000]);
        assert_eq!(first_steps(7_000, 400, &config), [400, 800, 1_200]);
        // As in a measurement that wants all degrees at once.
        let at_once = TrainSettings::default().with_sh_degree_every(1);
        assert_eq!(first_steps(300, 400, &at_once), [1, 2, 3]);
    }

    #[test]
    fn several_views_of_a_step_pass_sooner() {
        let config = TrainSettings::default().with_views_per_step(4);
        assert_eq!(first_steps(120, 30, &config), [8, 16, 24]);
    }
}
