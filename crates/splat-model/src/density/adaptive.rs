//! Adaptive density control of 3DGS (section 5.2), with the defaults of gsplat.

use burn::tensor::Tensor;
use glam::{Quat, Vec3};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};
use splat_ops::{OpError, Projected, ScreenStatistics};

use super::edit::{RowPlan, apply_plan, clamp_opacities};
use crate::adam::EditLog;
use crate::gaussians::host;
use splat_data::SceneScale;
use splat_data::SplatData;

use crate::Gaussians;

/// The run length that the milestones below are stated for.
const REFERENCE_STEPS: f64 = 30_000.0;

/// Settings of adaptive density control. Milestones are stated for a run of 30,000 steps and shrink
/// with shorter runs. Intervals do not: statistics need their hundred views, and opacities their
/// hundreds of steps to recover from a reset, however short the run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AdaptiveSettings {
    /// Rows may be added after this step, or after a quarter of the run where that is sooner: before,
    /// gradients are those of a scene that has not formed yet. Default 500.
    pub start: usize,
    /// Milestone: no rows are added or removed after this step. Default 15,000.
    pub stop: usize,
    /// Interval: steps between refinements. Default 100.
    pub every: usize,
    /// Interval: steps between opacity resets. Default 3,000.
    pub reset_every: usize,
    /// A Gaussian is cloned or split when its mean screen gradient exceeds this, in half images.
    /// Default 2e-4.
    pub grow_gradient: f64,
    /// Above this share of the scene's scale a Gaussian is split, below it cloned. Default 0.01.
    pub split_scale: f64,
    /// Below this opacity a Gaussian is removed. Default 0.005.
    pub prune_opacity: f64,
    /// Above this share of the scene's scale a Gaussian is removed. Default 0.1.
    pub prune_scale: f64,
    /// Large Gaussians are removed only after this step, that of the first reset of opacities in 3DGS. Like the interval
    /// of resets it does not shrink with the run: what is far away starts large and needs its time to split. Default
    /// 3,000.
    pub prune_scale_start: usize,
    /// Opacity that a reset leaves. Default 0.01.
    pub reset_opacity: f64,
    /// No growth beyond this many Gaussians. Default: none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_gaussians: Option<usize>,
}

impl Default for AdaptiveSettings {
    fn default() -> Self {
        Self {
            start: 500,
            stop: 15_000,
            every: 100,
            reset_every: 3_000,
            grow_gradient: 2e-4,
            split_scale: 0.01,
            prune_opacity: 0.005,
            prune_scale: 0.1,
            prune_scale_start: 3_000,
            reset_opacity: 0.01,
            max_gaussians: None,
        }
    }
}

/// What of the run density control needs to know.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RunShape {
    /// Steps of the whole run.
    pub steps: usize,
    /// Size of the scene.
    pub scene_scale: SceneScale,
    /// Seed of the run.
    pub seed: u64,
}

impl RunShape {
    /// A milestone of a run of 30,000 steps in this run, at least 1. Longer runs keep it.
    pub fn milestone(&self, step: usize) -> usize {
        let share = (self.steps as f64 / REFERENCE_STEPS).min(1.0);
        ((step as f64 * share).round() as usize).max(1)
    }
}

/// What one refinement did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Refinement {
    /// Small Gaussians that were duplicated.
    pub cloned: usize,
    /// Large Gaussians that were replaced by two smaller ones.
    pub split: usize,
    /// Gaussians removed for being transparent or too large.
    pub pruned: usize,
    /// Whether opacities were reset.
    pub reset: bool,
}

/// The strategy: feed every step to [`observe`](Self::observe), then call [`refine`](Self::refine).
#[derive(Debug, Clone)]
pub struct AdaptiveDensity {
    settings: AdaptiveSettings,
    run: RunShape,
    /// Per Gaussian, sum of screen gradients and number of views that saw it, since the last
    /// refinement.
    statistics: Option<ScreenStatistics>,
}

impl AdaptiveDensity {
    /// A strategy for one run.
    pub fn new(settings: AdaptiveSettings, run: RunShape) -> Self {
        Self {
            settings,
            run,
            statistics: None,
        }
    }

    /// Whether this step's screen gradients matter; without them no probe is needed.
    pub fn observes(&self, step: usize) -> bool {
        step < self.run.milestone(self.settings.stop)
    }

    /// Takes in a step: its splats, and the gradient `[C, N, 9]` of their packed rows.
    ///
    /// # Errors
    /// When they do not fit each other.
    pub fn observe(
        &mut self,
        screen_gradient: Tensor<3>,
        projected: &Projected,
    ) -> Result<(), OpError> {
        let [_, n, _] = screen_gradient.dims();
        let before = self
            .statistics
            .take()
            .filter(|sums| sums.views.dims() == [n]);
        let before = before.unwrap_or_else(|| {
            let zeros = Tensor::zeros([n], (&screen_gradient.device(), screen_gradient.dtype()));
            ScreenStatistics {
                gradients: zeros.clone(),
                views: zeros,
            }
        });
        self.statistics = Some(before.add(screen_gradient, projected)?);
        Ok(())
    }

    /// Sums of screen gradients and numbers of views per Gaussian so far, on the host, to be saved.
    pub fn statistics(&self) -> Option<(Vec<f32>, Vec<f32>)> {
        let sums = self.statistics.clone()?;
        Some((host(sums.gradients), host(sums.views)))
    }

    /// Puts back what [`statistics`](Self::statistics) gave.
    pub fn restore_statistics(&mut self, gradients: Tensor<1>, views: Tensor<1>) {
        self.statistics = Some(ScreenStatistics { gradients, views });
    }

    /// After `step` (counted from 1): adds and removes rows when it is time to.
    pub fn refine(
        &mut self,
        step: usize,
        mut gaussians: Gaussians,
        logs: &[EditLog; 6],
    ) -> (Gaussians, Option<Refinement>) {
        let settings = &self.settings;
        if step > self.run.milestone(settings.stop) {
            self.statistics = None;
            return (gaussians, None);
        }
        let mut report = None;
        let start = settings.start.min(self.run.steps / 4);
        let due = step > start && step.is_multiple_of(settings.every);
        if due && let Some(sums) = self.statistics.take() {
            let gradients: Vec<f64> = host(sums.gradients)
                .into_iter()
                .zip(host(sums.views))
                .map(|(total, views)| f64::from(total) / f64::from(views.max(1.0)))
                .collect();
            let splats = gaussians.to_data();
            let (mut plan, refinement) = self.plan(step, &splats, &gradients);
            if refinement != Refinement::default() {
                plan.arrange(&splats.means);
                gaussians = apply_plan(gaussians, &plan, logs);
            }
            report = Some(refinement);
        }
        if step.is_multiple_of(self.settings.reset_every)
            && step < self.run.milestone(self.settings.stop)
        {
            gaussians = clamp_opacities(gaussians, self.settings.reset_opacity, logs);
            report.get_or_insert_default().reset = true;
        }
        (gaussians, report)
    }

    /// Decides, from plain values: clones first, then splits, then what is pruned of it all.
    fn plan(&self, step: usize, splats: &SplatData, gradients: &[f64]) -> (RowPlan, Refinement) {
        let settings = &self.settings;
        let scale = |row: usize| {
            let largest = splats.log_scales[row].into_iter().fold(f32::MIN, f32::max);
            f64::from(largest).exp() / self.run.scene_scale.length()
        };
        let room = settings
            .max_gaussians
            .map_or(usize::MAX, |most| most.saturating_sub(splats.len()));
        // Where not all can grow, those do that need it most.
        let mut growing: Vec<usize> = (0..splats.len())
            .filter(|row| gradients[*row] > settings.grow_gradient)
            .collect();
        if growing.len() > room {
            growing.sort_by(|a, b| gradients[*b].total_cmp(&gradients[*a]));
            growing.truncate(room);
            growing.sort_unstable();
        }
        let mut growing = growing.into_iter().peekable();
        let mut report = Refinement::default();
        let mut plan = RowPlan::default();
        let mut clones = Vec::new();
        let mut splits = Vec::new();
        for row in 0..splats.len() {
            let grows = growing.next_if_eq(&row).is_some();
            if grows && scale(row) > settings.split_scale {
                splits.push(row);
                continue;
            }
            plan.keep(row as u32);
            if grows {
                clones.push(row);
            }
        }
        for row in &clones {
            plan.add(*row as u32, [0.0; 3], 0.0);
        }
        let smaller = -(1.6f32.ln());
        for row in &splits {
            for half in 0..2 {
                plan.add(*row as u32, self.sample(step, *row, half, splats), smaller);
            }
        }
        (report.cloned, report.split) = (clones.len(), splits.len());

        let prunes_large = step > settings.prune_scale_start;
        let before = plan.source.len();
        let decisions: Vec<bool> = plan
            .source
            .iter()
            .zip(&plan.log_scale_offset)
            .map(|(row, offset)| {
                let row = *row as usize;
                let opacity = 1.0 / (1.0 + f64::from(-splats.opacity_logits[row]).exp());
                let large = scale(row) * f64::from(*offset).exp() > settings.prune_scale;
                opacity >= settings.prune_opacity && !(prunes_large && large)
            })
            .collect();
        // A model that would lose every row keeps them: nothing could grow back.
        if decisions.contains(&true) {
            plan.retain(|row| decisions[row]);
        }
        report.pruned = before - plan.source.len();
        (plan, report)
    }

    /// A draw from the Gaussian around its mean, from (seed, step, row, half) alone.
    fn sample(&self, step: usize, row: usize, half: u64, splats: &SplatData) -> [f32; 3] {
        let id = (row as u64) * 2 + half;
        let seed = self.run.seed ^ (step as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        let mut rng = Pcg64Mcg::seed_from_u64(seed ^ id.wrapping_mul(0xD1B5_4A32_D192_ED03));
        let normal = Vec3::from_array([(); 3].map(|()| StandardNormal.sample(&mut rng)));
        let scales = Vec3::from_array(splats.log_scales[row]).exp();
        let [w, x, y, z] = splats.quats[row];
        let rotation = Quat::from_xyzw(x, y, z, w).normalize();
        let offset = rotation * (scales * normal);
        // A quaternion without length has no axes to draw along.
        if offset.is_finite() {
            offset.to_array()
        } else {
            [0.0; 3]
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(steps: usize) -> RunShape {
        RunShape {
            steps,
            scene_scale: SceneScale::new(2.0).unwrap(),
            seed: 1,
        }
    }

    /// Four Gaussians: still, small and growing, large and growing, transparent.
    fn splats() -> SplatData {
        SplatData {
            means: vec![[0.0; 3]; 4],
            log_scales: [0.01f32, 0.01, 0.1, 0.01].map(|s| [s.ln(); 3]).to_vec(),
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 4],
            opacity_logits: vec![0.0, 0.0, 0.0, -6.0],
            sh0: vec![[0.0; 3]; 4],
            ..SplatData::default()
        }
    }

    const GRADIENTS: [f64; 4] = [1e-4, 3e-4, 3e-4, 1e-4];

    #[test]
    fn small_ones_are_cloned_large_ones_split_transparent_ones_pruned() {
        let density = AdaptiveDensity::new(AdaptiveSettings::default(), run(30_000));
        let (plan, report) = density.plan(600, &splats(), &GRADIENTS);
        assert_eq!((report.cloned, report.split, report.pruned), (1, 1, 1));
        assert_eq!(plan.source, [0, 1, 1, 2, 2]);
        assert_eq!(plan.survives, [true, true, false, false, false]);
        assert!((f64::from(plan.log_scale_offset[3]) + 1.6f64.ln()).abs() < 1e-6);
        // The halves lie within a few standard deviations, not in one place, and the same next time.
        assert_ne!(plan.mean_offset[3], plan.mean_offset[4]);
        assert!(
            plan.mean_offset[3..]
                .iter()
                .flatten()
                .all(|x| x.abs() < 0.6)
        );
        assert_eq!(plan, density.plan(600, &splats(), &GRADIENTS).0);
    }

    #[test]
    fn where_not_all_can_grow_those_do_that_need_it_most() {
        let settings = AdaptiveSettings {
            max_gaussians: Some(5),
            ..Default::default()
        };
        let density = AdaptiveDensity::new(settings, run(30_000));
        let grown = |gradients: [f64; 4]| {
            let plan = density.plan(600, &splats(), &gradients).0;
            plan.source[plan.survives.iter().filter(|survives| **survives).count()]
        };
        assert_eq!(grown([3e-4, 4e-4, 0.0, 0.0]), 1);
        assert_eq!(grown([4e-4, 3e-4, 0.0, 0.0]), 0);
        assert_eq!(grown([4e-4, 3e-4, 5e-4, f64::NAN]), 2);
    }

    #[test]
    fn refined_rows_are_neighbours_in_memory_and_keep_their_moments() {
        let mut plan = RowPlan::default();
        let means = [[3.0, 3.0, 3.0], [0.0, 0.0, 0.0], [2.9, 3.0, 3.0]];
        for row in 0..3 {
            plan.keep(row);
        }
        plan.add(1, [0.1, 0.0, 0.0], -0.5);
        plan.arrange(&means);
        assert_eq!(plan.source, [1, 1, 2, 0]);
        assert_eq!(plan.survives, [true, false, true, true]);
        assert_eq!(plan.mean_offset[1], [0.1, 0.0, 0.0]);
        assert_eq!(plan.log_scale_offset, [0.0, -0.5, 0.0, 0.0]);
    }

    #[test]
    fn the_cap_stops_growth_and_the_last_ones_stay() {
        let settings = AdaptiveSettings {
            max_gaussians: Some(5),
            prune_opacity: 0.9,
            ..Default::default()
        };
        let density = AdaptiveDensity::new(settings, run(30_000));
        let (plan, report) = density.plan(600, &splats(), &GRADIENTS);
        assert_eq!((report.cloned, report.split, report.pruned), (1, 0, 0));
        assert_eq!(plan.source.len(), 5);
    }

    #[test]
    fn large_ones_are_pruned_only_later() {
        let mut splats = splats();
        splats.log_scales[0] = [0.5f32.ln(); 3];
        let density = AdaptiveDensity::new(AdaptiveSettings::default(), run(30_000));
        let pruned = |step| density.plan(step, &splats, &[0.0; 4]).1.pruned;
        assert_eq!((pruned(600), pruned(3_100)), (1, 2));
    }

    #[cfg(feature = "cpu")]
    #[test]
    fn a_gradient_that_is_not_finite_does_not_hide_other_views() {
        let device = burn::tensor::Device::flex();
        let mut density = AdaptiveDensity::new(AdaptiveSettings::default(), run(30_000));
        let size = splat_ops::ImageSize {
            width: 2,
            height: 2,
        };
        for x in [3.0, f32::NAN, f32::INFINITY, 1.0] {
            let [first, second] = [x, 2.0].map(|x| [x, 0.0, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0]);
            let gradient = Tensor::<3>::from_floats([[first, second]], &device);
            let seen = Projected::from_packed(Tensor::ones([1, 2, 9], &device), size).unwrap();
            density.observe(gradient, &seen).unwrap();
        }
        let (gradients, views) = density.statistics().unwrap();
        assert_eq!((gradients, views), (vec![4.0, 8.0], vec![4.0, 4.0]));
    }

    #[test]
    fn milestones_shrink_with_the_run() {
        assert_eq!(run(3_000).milestone(15_000), 1_500);
        assert_eq!(run(60_000).milestone(500), 500);
    }
}
