//! Adaptive density control of 3DGS (section 5.2), with the defaults of gsplat; docs/STRATEGIES.md
//! has what differs.

use burn::tensor::Device;
use derive_setters::Setters;
use serde::{Deserialize, Serialize};
use splat_ops::{OpError, RowGroups};
use tracing::trace_span;

use super::relocation::relocate_logit;
use super::screen_sums::ScreenSums;
use super::splats::Splats;
use super::{
    Refinement, RowsNeeded, ScreenView, ScreenWants, SparseStep, StepContext, StepInfo, Strategy,
    check_fields, draw,
};
use crate::optimizer::StateRecord;
use crate::rows::{Moments, RowEdit};
use crate::{Field, SplatModel};

/// Settings of adaptive density control. Milestones are stated for a run of 30,000 steps and shrink
/// with shorter runs. Intervals do not: statistics need their hundred views, and opacities their
/// hundreds of steps to recover from a reset, however short the run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Setters)]
#[serde(default, deny_unknown_fields)]
#[setters(prefix = "with_", strip_option)]
pub struct AdcSettings {
    /// Rows may be added after this step, or after a quarter of the run where that is sooner:
    /// before, gradients are those of a scene that has not formed yet. Default 500.
    pub start: usize,
    /// Milestone: no rows are added or removed after this step. Default 15,000.
    pub stop: usize,
    /// Interval: steps between refinements. Default 100.
    pub every: usize,
    /// Interval: steps between opacity resets. Default 3,000.
    pub reset_every: usize,
    /// Measures growth by the absolute gradients of the pixels instead of their sum, which cancels
    /// in large Gaussians (Ye et al. 2024, *AbsGS*). Default false.
    pub absgrad: bool,
    /// A Gaussian is cloned or split when its mean screen gradient exceeds this, in half images.
    /// Default 2e-4, and 6e-4 of absolute gradients, which are larger (gsplat's evaluation; its
    /// documentation suggests 8e-4).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub grow_gradient: Option<f64>,
    /// The halves of a split have the opacity `1 - sqrt(1 - o)`, with which two in one place look
    /// like their parent (Bulò et al. 2024, *Revising Densification in Gaussian Splatting*, eq. 4),
    /// instead of its own. Default false.
    pub revised_opacity: bool,
    /// Above this share of the scene's scale a Gaussian is split, below it cloned. Default 0.01.
    pub split_scale: f64,
    /// Below this opacity a Gaussian is removed. Default 0.005.
    pub prune_opacity: f64,
    /// Above this share of the scene's scale a Gaussian is removed. Default 0.1.
    pub prune_scale: f64,
    /// Large Gaussians are removed only after this step, that of the first reset of opacities in
    /// 3DGS. Like the interval of resets it does not shrink with the run: what is far away starts
    /// large and needs its time to split. Default 3,000.
    pub prune_scale_start: usize,
    /// Opacity that a reset leaves. Default 0.01.
    pub reset_opacity: f64,
    /// No growth beyond this many Gaussians. Default: none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_gaussians: Option<usize>,
}

impl AdcSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }

    /// The threshold of growth, as set or by default.
    pub fn threshold(&self) -> f64 {
        let usual = if self.absgrad { 6e-4 } else { 2e-4 };
        self.grow_gradient.unwrap_or(usual)
    }
}

impl Default for AdcSettings {
    fn default() -> Self {
        Self {
            start: 500,
            stop: 15_000,
            every: 100,
            reset_every: 3_000,
            absgrad: false,
            grow_gradient: None,
            revised_opacity: false,
            split_scale: 0.01,
            prune_opacity: 0.005,
            prune_scale: 0.1,
            prune_scale_start: 3_000,
            reset_opacity: 0.01,
            max_gaussians: None,
        }
    }
}

/// The strategy of 3DGS: Gaussians whose screen gradients are large are cloned or split, faint and
/// large ones removed, and opacities reset now and then.
///
/// With [`absgrad`](AdcSettings::absgrad) it is that of AbsGS.
#[derive(Debug, Clone)]
pub struct Adc {
    settings: AdcSettings,
    /// Since the last refinement.
    sums: ScreenSums,
}

impl Adc {
    /// A strategy for one run. Without `max_gaussians` nothing limits growth; the trainer's own,
    /// which it makes where no strategy is given, takes a limit from the photos.
    pub fn new(settings: AdcSettings) -> Self {
        Self {
            settings,
            sums: ScreenSums::default(),
        }
    }

    /// Decides, from plain values: clones first, then splits, then what is pruned of it all.
    fn plan(&self, at: &StepInfo, splats: &Splats, gradients: &[f64]) -> (RowEdit, Refinement) {
        let draw = |row: usize, half: u64| draw::normals(at, (row as u64) * 2 + half);
        self.plan_with(at, splats, gradients, draw)
    }

    /// The same with the standard normal draws of the halves of each row.
    pub(super) fn plan_with(
        &self,
        at: &StepInfo,
        splats: &Splats,
        gradients: &[f64],
        draw: impl Fn(usize, u64) -> [f64; 3],
    ) -> (RowEdit, Refinement) {
        let (mut edit, mut report) = self.grow(at, splats, gradients, draw);
        let settings = &self.settings;
        let prunes_large = at.step > settings.prune_scale_start;
        let before = edit.len();
        let sources = edit.sources();
        let keeps = |row: usize| {
            let source = sources[row] as usize;
            let shrunk = edit
                .offset_of(row, "log_scales")
                .map_or(0.0, |offset| offset[0]);
            let opacity = match edit.offset_of(row, "opacity_logits") {
                Some(_) => revised(splats.opacity(source)),
                None => splats.opacity(source),
            };
            let large = scale(at, splats, source) * shrunk.exp() > settings.prune_scale;
            opacity >= settings.prune_opacity && !(prunes_large && large)
        };
        let kept: Vec<bool> = (0..before).map(keeps).collect();
        // A model that would lose every row keeps them: nothing could grow back.
        if kept.contains(&true) {
            edit.retain(|row| kept[row]);
        }
        report.pruned = before - edit.len();
        (edit, report)
    }

    /// The rows that stay, then the clones, then the halves.
    fn grow(
        &self,
        at: &StepInfo,
        splats: &Splats,
        gradients: &[f64],
        draw: impl Fn(usize, u64) -> [f64; 3],
    ) -> (RowEdit, Refinement) {
        let mut growing = self.growing(splats, gradients).into_iter().peekable();
        let mut edit = RowEdit::default();
        let (mut clones, mut splits) = (Vec::new(), Vec::new());
        for row in 0..splats.len() {
            let grows = growing.next_if_eq(&row).is_some();
            if grows && scale(at, splats, row) > self.settings.split_scale {
                splits.push(row);
                continue;
            }
            edit.push(row, Moments::Keep);
            if grows {
                clones.push(row);
            }
        }
        for row in &clones {
            edit.push(*row, Moments::Restart);
        }
        let smaller = -(1.6f64.ln());
        for row in &splits {
            for half in 0..2 {
                let new = edit.push(*row, Moments::Restart);
                edit.offset(new, "means", &splats.offset(*row, draw(*row, half)));
                edit.offset(new, "log_scales", &[smaller; 3]);
                if self.settings.revised_opacity {
                    let old = splats.opacity_logits[*row];
                    // By logits, of which an opacity next to one keeps no digit.
                    let change = relocate_logit(old, 2, &(0.0..=1.0)).0 - old;
                    // An infinite logit is an opacity of 0 or 1, and so are those of the halves.
                    if change.is_finite() {
                        edit.offset(new, "opacity_logits", &[change]);
                    }
                }
            }
        }
        let report = Refinement {
            cloned: clones.len(),
            split: splits.len(),
            ..Refinement::default()
        };
        (edit, report)
    }

    /// Adds what the views of a step say, of all rows or of some.
    fn add(&mut self, screen: &[ScreenView], rows: Option<&RowGroups>) -> Result<(), OpError> {
        let _span = trace_span!("density").entered();
        let absgrad = self.settings.absgrad;
        screen.iter().try_for_each(|view| {
            let gradient = if absgrad {
                &view.absgrad
            } else {
                &view.gradient
            };
            self.sums.add(view, gradient.as_ref(), rows)
        })
    }

    /// The rows that grow, in order. Where not all can, those do that need it most.
    fn growing(&self, splats: &Splats, gradients: &[f64]) -> Vec<usize> {
        let settings = &self.settings;
        let most = settings.max_gaussians.unwrap_or(usize::MAX);
        let room = most.saturating_sub(splats.len());
        let mut growing: Vec<usize> = (0..splats.len())
            .filter(|row| gradients[*row] > settings.threshold())
            .collect();
        if growing.len() > room {
            growing.sort_by(|a, b| gradients[*b].total_cmp(&gradients[*a]));
            growing.truncate(room);
            growing.sort_unstable();
        }
        growing
    }
}

impl<M: SplatModel> Strategy<M> for Adc {
    /// With its settings, apart from the limit of growth, which a resumed run may change.
    fn name(&self) -> String {
        let settings = AdcSettings {
            max_gaussians: None,
            ..self.settings.clone()
        };
        format!("adc with {settings:?}")
    }

    fn check(&self, fields: &[Field]) -> Result<(), String> {
        check_fields("adaptive density control", fields)?;
        let AdcSettings {
            every,
            reset_every,
            reset_opacity,
            prune_opacity,
            ..
        } = self.settings;
        if every == 0 || reset_every == 0 {
            return Err("`every` and `reset_every` must be at least 1".to_owned());
        }
        if !(0.0 < reset_opacity && reset_opacity < 1.0 && prune_opacity < reset_opacity) {
            return Err(format!(
                "`reset_opacity` is {reset_opacity} and `prune_opacity` {prune_opacity}; a reset must leave opacities between pruning and 1"
            ));
        }
        Ok(())
    }

    fn screen_wants(&self, at: &StepInfo) -> ScreenWants {
        if at.step >= at.run.milestone(self.settings.stop) {
            ScreenWants::nothing()
        } else if self.settings.absgrad {
            ScreenWants::absgrad()
        } else {
            ScreenWants::gradients()
        }
    }

    fn before_step(&mut self, context: &mut StepContext<M>) -> Result<(), OpError> {
        self.add(context.screen, None)
    }

    fn sparse_step(&mut self, step: &mut SparseStep) -> Result<(), OpError> {
        self.add(step.screen, Some(step.rows))
    }

    /// All where [`after_step`](Strategy::after_step) has something to do.
    fn rows_needed(&self, at: &StepInfo) -> RowsNeeded {
        let (done, stop) = (at.step + 1, at.run.milestone(self.settings.stop));
        let every = |steps: usize| done.is_multiple_of(steps);
        let due = match done > stop {
            true => !self.sums.is_empty(),
            false => every(self.settings.every) || every(self.settings.reset_every),
        };
        match due {
            true => RowsNeeded::AllAfter,
            false => RowsNeeded::Seen,
        }
    }

    fn after_step(&mut self, context: &mut StepContext<M>) -> Result<Option<Refinement>, OpError> {
        let StepInfo { step, run } = context.at;
        let settings = &self.settings;
        let stop = run.milestone(settings.stop);
        if step > stop {
            self.sums.clear();
            return Ok(None);
        }
        let (resets, reset_opacity) = (
            step.is_multiple_of(settings.reset_every) && step < stop,
            settings.reset_opacity,
        );
        let start = run.start(settings.start);
        let due = step > start && step.is_multiple_of(settings.every);
        let mut report = None;
        if due && let Some(gradients) = self.sums.take_means()? {
            let splats = Splats::read(context.model)?;
            let (mut edit, refinement) = self.plan(&context.at, &splats, &gradients);
            if refinement != Refinement::default() {
                edit.arrange(&splats.means);
                context.model.edit_rows(&edit)?;
            }
            report = Some(refinement);
        }
        if resets {
            context.model.clamp_opacities(reset_opacity)?;
            report.get_or_insert_default().reset = true;
        }
        Ok(report)
    }

    fn save(&self) -> Result<StateRecord, OpError> {
        self.sums.save()
    }

    fn restore(&mut self, record: StateRecord, rows: usize, device: &Device) -> Result<(), String> {
        self.sums = ScreenSums::restore(record, rows, device)?;
        Ok(())
    }
}

/// The largest scale of a Gaussian, in sizes of the scene.
fn scale(at: &StepInfo, splats: &Splats, row: usize) -> f64 {
    let largest = splats.log_scales[row].into_iter().fold(f64::MIN, f64::max);
    largest.exp() / at.run.scene_scale.length()
}

/// Opacity of each of two Gaussians in one place that together look like one of `opacity`.
fn revised(opacity: f64) -> f64 {
    1.0 - (1.0 - opacity).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::opacity::sigmoid;

    fn at(step: usize) -> StepInfo {
        let run = super::super::RunSchedule {
            steps: 30_000,
            scene_scale: splat_data::SceneScale::new(2.0).unwrap(),
            seed: 1,
        };
        StepInfo { step, run }
    }

    /// Four Gaussians: still, small and growing, large and growing, transparent.
    fn splats() -> Splats {
        Splats {
            means: vec![[0.0; 3]; 4],
            log_scales: [0.01f64, 0.01, 0.1, 0.01].map(|s| [s.ln(); 3]).to_vec(),
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 4],
            opacity_logits: vec![0.0, 0.0, 0.0, -6.0],
        }
    }

    const GRADIENTS: [f64; 4] = [1e-4, 3e-4, 3e-4, 1e-4];

    #[test]
    fn small_ones_are_cloned_large_ones_split_transparent_ones_pruned() {
        let density = Adc::new(AdcSettings::default());
        let (plan, report) = density.plan(&at(600), &splats(), &GRADIENTS);
        assert_eq!((report.cloned, report.split, report.pruned), (1, 1, 1));
        assert_eq!(plan.sources(), [0, 1, 1, 2, 2]);
        let (keep, restart) = (Moments::Keep, Moments::Restart);
        assert_eq!(plan.moments(), [keep, keep, restart, restart, restart]);
        let smaller = plan.offset_of(3, "log_scales").unwrap();
        assert!(smaller.iter().all(|x| (*x + 1.6f64.ln()).abs() < 1e-12));
        // The halves lie within a few standard deviations, not in one place, and the same next
        // time.
        let halves = [3, 4].map(|row| plan.offset_of(row, "means").unwrap());
        assert_ne!(halves[0], halves[1]);
        assert!(
            halves
                .iter()
                .flat_map(|half| half.iter())
                .all(|x| x.abs() < 0.6)
        );
        assert_eq!(plan, density.plan(&at(600), &splats(), &GRADIENTS).0);
    }

    #[test]
    fn where_not_all_can_grow_those_do_that_need_it_most() {
        let settings = AdcSettings {
            max_gaussians: Some(5),
            ..Default::default()
        };
        let density = Adc::new(settings);
        let grown = |gradients: [f64; 4]| {
            let plan = density.plan(&at(600), &splats(), &gradients).0;
            let first = plan
                .moments()
                .iter()
                .position(|moments| *moments == Moments::Restart);
            plan.sources()[first.unwrap()]
        };
        assert_eq!(grown([3e-4, 4e-4, 0.0, 0.0]), 1);
        assert_eq!(grown([4e-4, 3e-4, 0.0, 0.0]), 0);
        assert_eq!(grown([4e-4, 3e-4, 5e-4, f64::NAN]), 2);
    }

    #[test]
    fn the_cap_stops_growth_and_the_last_ones_stay() {
        let settings = AdcSettings {
            max_gaussians: Some(5),
            prune_opacity: 0.9,
            ..Default::default()
        };
        let density = Adc::new(settings);
        let (plan, report) = density.plan(&at(600), &splats(), &GRADIENTS);
        assert_eq!((report.cloned, report.split, report.pruned), (1, 0, 0));
        assert_eq!(plan.len(), 5);
    }

    #[test]
    fn two_halves_with_the_revised_opacity_look_like_their_parent() {
        let settings = AdcSettings::new().with_revised_opacity(true);
        let (plan, _) = Adc::new(settings).plan(&at(600), &splats(), &GRADIENTS);
        for half in [3, 4] {
            let logit = plan.offset_of(half, "opacity_logits").unwrap()[0];
            let opacity = sigmoid(logit);
            assert!((1.0 - (1.0 - opacity).powi(2) - 0.5).abs() < 1e-12);
        }
        // A clone is an exact copy.
        assert_eq!(plan.offset_of(2, "opacity_logits"), None);
    }

    #[test]
    fn large_ones_are_pruned_only_later() {
        let mut splats = splats();
        splats.log_scales[0] = [0.5f64.ln(); 3];
        let density = Adc::new(AdcSettings::default());
        let pruned = |step| density.plan(&at(step), &splats, &[0.0; 4]).1.pruned;
        assert_eq!((pruned(600), pruned(3_100)), (1, 2));
    }
}
