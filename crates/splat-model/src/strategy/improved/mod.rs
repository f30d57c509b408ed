//! Improved-GS (Deng et al. 2025, *Improving Densification in 3D Gaussian Splatting for
//! High-Fidelity Rendering*): splits along the longest axis, sampled by the edges of the photos, up
//! to a budget; and natural selection of fewer Gaussians after that (Deng et al. 2025,
//! *Gradient-Driven Natural Selection for Compact 3D Gaussian Splatting*, GNS).

mod edges;
mod growth;
mod selection;
mod settings;
mod split;
#[cfg(test)]
mod tests;

use burn::tensor::{Device, Tensor};
use splat_ops::OpError;
use tracing::trace_span;

#[cfg(all(test, feature = "cpu"))]
pub(super) use self::edges::{edge_map, relative_scores};
use self::edges::{edge_scores, views_in_turn};
use self::growth::Growth;
pub(super) use self::selection::pressure;
use self::selection::{Selection, Times, last_survivor};
use self::split::long_axis_split;
use super::screen_sums::ScreenSums;
use super::splats::Splats;
use super::{Pass, Refinement, ScreenWants, StepContext, StepInfo, Strategy, check_fields, draw};
use crate::opacity::sigmoid;
use crate::optimized::tracked_field;
use crate::optimizer::StateRecord;
use crate::rows::{Moments, RowEdit};
use crate::{Field, FieldStep, Optimized, SplatModel};

pub use selection::SelectionSettings;
pub use settings::ImprovedGsSettings;

/// The field that selection presses on.
const OPACITIES: &str = "opacity_logits";

/// The strategy of Improved-GS: those whose absolute screen gradients are large are split along
/// their longest axis, as many as a budget that grows with the run allows, drawn by the edges of
/// the photos that they are seen on. With [`final_gaussians`](SelectionSettings::final_gaussians)
/// or a share that of GNS: it grows to more than needed, and then a pressure on all opacities
/// selects.
///
/// ```
/// use splat_model::strategy::{ImprovedGs, ImprovedGsSettings};
///
/// let strategy = ImprovedGs::new(ImprovedGsSettings::new().with_max_gaussians(100_000));
/// # let _ = strategy;
/// ```
#[derive(Debug, Clone)]
pub struct ImprovedGs {
    settings: ImprovedGsSettings,
    /// Since the last refinement.
    sums: ScreenSums,
    selection: Selection,
}

/// What a refinement goes by.
#[derive(Debug, Clone, Copy)]
pub(super) struct Refining<'a> {
    /// Mean absolute screen gradients.
    pub(super) gradients: &'a [f64],
    /// Weights of the draw of those that are split.
    pub(super) scores: &'a [f64],
    /// Gradients from which a Gaussian may be split.
    pub(super) threshold: f64,
    /// How many there may be.
    pub(super) budget: usize,
    /// How many of the faintest are removed before.
    pub(super) unrecovered: usize,
    /// Opacity below which one is removed after.
    pub(super) prune_opacity: f64,
}

impl ImprovedGs {
    /// A strategy for one run. Without `max_gaussians` nothing limits growth; the trainer takes a
    /// limit from the photos for those that it makes itself.
    pub fn new(settings: ImprovedGsSettings) -> Self {
        Self {
            selection: Selection::new(&settings.selection),
            settings,
            sums: ScreenSums::default(),
        }
    }

    fn growth(&self, at: &StepInfo) -> Growth {
        Growth::new(&self.settings, &at.run)
    }

    /// When there is a selection, and how many survive it.
    fn selecting(&self, at: &StepInfo) -> Option<(Times, usize)> {
        let survivors = self.settings.survivors()?;
        let growth = self.growth(at);
        let times = Times::new(&self.settings.selection, growth.stop, &at.run);
        Some((times, survivors))
    }

    /// How many of so many are removed for not having recovered.
    fn unrecovered(&self, count: usize) -> usize {
        (count as f64 * self.settings.recovery_prune_share) as usize
    }

    /// Removes those that fail a test, unless all do.
    fn prune<M: SplatModel>(
        &mut self,
        model: &mut Optimized<M>,
        keeps: impl Fn(f64) -> bool,
    ) -> Result<Refinement, OpError> {
        let [logits] = model.read_f64([OPACITIES])?;
        let kept: Vec<bool> = logits.iter().map(|logit| keeps(sigmoid(*logit))).collect();
        self.keep(model, &kept)
    }

    /// Keeps these rows, or all where none would be kept: nothing could grow back.
    fn keep<M: SplatModel>(
        &mut self,
        model: &mut Optimized<M>,
        kept: &[bool],
    ) -> Result<Refinement, OpError> {
        let pruned = kept.iter().filter(|kept| !**kept).count();
        if pruned == 0 || pruned == kept.len() {
            return Ok(Refinement::default());
        }
        let mut edit = RowEdit::identity(kept.len());
        edit.retain(|row| kept[row]);
        model.edit_rows(&edit)?;
        // They are of the rows that there were.
        self.sums.clear();
        Ok(Refinement {
            pruned,
            ..Refinement::default()
        })
    }

    /// Scores, splits and prunes; the gradients of the time since the last refinement are taken.
    fn refine<M: SplatModel>(
        &mut self,
        context: &mut StepContext<M>,
        turn: usize,
        unrecovered: bool,
    ) -> Result<Refinement, OpError> {
        let (at, growth) = (context.at, self.growth(&context.at));
        let splats = Splats::read(context.model)?;
        let gradients = self.sums.take_means()?;
        let gradients = gradients.unwrap_or_else(|| vec![0.0; splats.len()]);
        let fills = growth.fills(at.step);
        let scores = match fills {
            true => gradients.clone(),
            false => {
                let count = context.views.count();
                let views = match self.settings.has_pruned_unrecovered(&at, &growth) {
                    true => (0..count).collect(),
                    false => views_in_turn(count, self.settings.edge_views, turn),
                };
                let model = context.model.model();
                edge_scores(model, context.views, &views, &context.settings)?
            }
        };
        let refining = Refining {
            gradients: &gradients,
            scores: &scores,
            threshold: match fills {
                true => self.settings.fill_gradient,
                false => self.settings.grow_gradient,
            },
            budget: growth.budget(at.step),
            unrecovered: match unrecovered {
                true => self.unrecovered(splats.len()),
                false => 0,
            },
            // After the last one nothing would grow into the place of what it removes.
            prune_opacity: match growth.is_last(at.step) {
                true => 0.0,
                false => self.settings.prune_opacity,
            },
        };
        let uniform = |row: usize| draw::uniform(&at, row as u64);
        let (mut edit, report) = plan(&splats, &refining, uniform);
        if report != Refinement::default() {
            edit.arrange(&splats.means);
            context.model.edit_rows(&edit)?;
        }
        Ok(report)
    }

    /// Growth after a step.
    fn grow<M: SplatModel>(
        &mut self,
        context: &mut StepContext<M>,
    ) -> Result<Option<Refinement>, OpError> {
        let (at, growth) = (context.at, self.growth(&context.at));
        let mut report = None;
        if at.step == self.settings.early_prune.min(growth.start) {
            let least = self.settings.early_prune_opacity;
            report = Some(self.prune(context.model, |opacity| opacity >= least)?);
        }
        let unrecovered = self.settings.prunes_unrecovered(&at);
        if let Some(turn) = growth.refinement(at.step) {
            report = Some(self.refine(context, turn, unrecovered)?);
        } else if unrecovered {
            let [logits] = context.model.read_f64([OPACITIES])?;
            let kept = all_but_the_faintest(&logits, self.unrecovered(logits.len()));
            report = Some(self.keep(context.model, &kept)?);
        }
        if self.settings.resets(&at) {
            let opacity = self.settings.reset_opacity;
            context.model.clamp_opacities(opacity)?;
            report.get_or_insert_default().reset = true;
        }
        Ok(report)
    }

    /// Selection after a step.
    fn select<M: SplatModel>(
        &mut self,
        context: &mut StepContext<M>,
    ) -> Result<Option<Refinement>, OpError> {
        let (at, step) = (context.at, context.at.step);
        let Some((times, survivors)) = self.selecting(&at) else {
            return Ok(None);
        };
        if step < times.start || self.selection.is_over() {
            return Ok(None);
        }
        let mut report = None;
        if times.prunes(step) {
            let least = self.settings.selection.prune_opacity;
            report = Some(self.prune(context.model, |opacity| opacity >= least)?);
        }
        let count = context.model.model().count();
        if self.selection.ends(&times, step, count, survivors) {
            self.selection.end(step);
            let removed = self.draw_survivors(context, survivors)?;
            report.get_or_insert_default().pruned += removed;
        } else if !self.selection.is_on() || times.controls(step) {
            let [logits] = context.model.read_f64([OPACITIES])?;
            let opacities = logits.into_iter().map(sigmoid).collect();
            let last = last_survivor(opacities, survivors);
            self.selection.control(&times, step, last);
        }
        Ok(report)
    }

    /// Keeps so many, drawn by opacity, and returns how many were removed.
    fn draw_survivors<M: SplatModel>(
        &mut self,
        context: &mut StepContext<M>,
        survivors: usize,
    ) -> Result<usize, OpError> {
        let at = context.at;
        let [logits] = context.model.read_f64([OPACITIES])?;
        let opacities = logits.into_iter().map(sigmoid);
        let weighted: Vec<(usize, f64)> = opacities.enumerate().collect();
        if weighted.len() <= survivors {
            return Ok(0);
        }
        let uniform = |row: usize| draw::uniform(&at, row as u64);
        let mut kept = vec![false; weighted.len()];
        for row in draw::without_replacement(&weighted, survivors, uniform) {
            kept[row] = true;
        }
        Ok(self.keep(context.model, &kept)?.pruned)
    }

    /// One update of the optimiser for so many steps.
    fn steps_per_update(&self, at: &StepInfo) -> usize {
        if !self.settings.multi_step_updates {
            return 1;
        }
        // Selection needs its gradients at once, and ends later than growth.
        let [few, many] = match self.settings.survivors() {
            None => [15_000, 22_500],
            Some(_) => [20_000, 24_000],
        };
        let run = at.run;
        match at.step + 1 {
            step if step > run.milestone(many) => run.milestone(20),
            step if step > run.milestone(few) => run.milestone(5),
            _ => 1,
        }
    }
}

/// Decides, from plain values: removes the faintest, splits as many as fit into the budget, then
/// prunes. `uniform` gives a draw from [0, 1) for each row.
pub(super) fn plan(
    splats: &Splats,
    refining: &Refining,
    uniform: impl Fn(usize) -> f64,
) -> (RowEdit, Refinement) {
    let kept = all_but_the_faintest(&splats.opacity_logits, refining.unrecovered);
    let rows: Vec<usize> = (0..splats.len()).filter(|row| kept[*row]).collect();
    let may_split = |row: &&usize| refining.gradients[**row] >= refining.threshold;
    let candidates: Vec<(usize, f64)> = (rows.iter().filter(may_split))
        .map(|row| (*row, refining.scores[*row]))
        .collect();
    // A split adds one.
    let room = refining.budget.saturating_sub(rows.len());
    let chosen = draw::without_replacement(&candidates, room, uniform);

    let mut edit = RowEdit::default();
    let mut opacities = Vec::new();
    let mut splitting = chosen.iter().copied().peekable();
    for row in &rows {
        if splitting.next_if_eq(row).is_none() {
            edit.push(*row, Moments::Keep);
            opacities.push(splats.opacity(*row));
        }
    }
    for row in &chosen {
        let halves = long_axis_split(splats, *row);
        for offset in &halves.offsets {
            let new = edit.push(*row, Moments::Restart);
            edit.offset(new, "means", offset);
            edit.offset(new, "log_scales", &halves.log_scales);
            edit.set(new, OPACITIES, &[halves.opacity_logit]);
            opacities.push(sigmoid(halves.opacity_logit));
        }
    }
    let is_kept = |row: usize| opacities[row] >= refining.prune_opacity;
    let after = (0..edit.len()).filter(|row| is_kept(*row)).count();
    let report = Refinement {
        split: chosen.len(),
        pruned: splats.len() + chosen.len() - after,
        ..Refinement::default()
    };
    // A model that would lose every row keeps them: nothing could grow back.
    if after == 0 {
        return (RowEdit::identity(splats.len()), Refinement::default());
    }
    edit.retain(is_kept);
    (edit, report)
}

/// Which rows are left without so many of the lowest opacities. Of equal ones the first go.
fn all_but_the_faintest(opacity_logits: &[f64], count: usize) -> Vec<bool> {
    let mut kept = vec![true; opacity_logits.len()];
    if count > 0 {
        let mut order: Vec<usize> = (0..opacity_logits.len()).collect();
        order.sort_by(|a, b| opacity_logits[*a].total_cmp(&opacity_logits[*b]));
        order.iter().take(count).for_each(|row| kept[*row] = false);
    }
    kept
}

impl<M: SplatModel> Strategy<M> for ImprovedGs {
    /// With its settings, apart from the limit of growth, which a resumed run may change.
    fn name(&self) -> String {
        let settings = ImprovedGsSettings {
            max_gaussians: None,
            ..self.settings.clone()
        };
        format!("improved with {settings:?}")
    }

    fn check(&self, fields: &[Field]) -> Result<(), String> {
        check_fields("Improved-GS", fields)?;
        self.settings.validate()
    }

    fn screen_wants(&self, at: &StepInfo) -> ScreenWants {
        match self.growth(at).measures(at.step) {
            true => ScreenWants::absgrad(),
            false => ScreenWants::nothing(),
        }
    }

    fn loss_term_names(&self) -> Vec<String> {
        let selects = self.settings.survivors().is_some();
        (selects.then(|| "opacity pressure".to_owned()).into_iter()).collect()
    }

    /// The pressure of selection, in the steps in which it acts.
    fn loss_terms(&self, pass: &Pass<M>) -> Result<Vec<Tensor<1>>, OpError> {
        let Some((times, _)) = self.selecting(&pass.at) else {
            return Ok(Vec::new());
        };
        let logits = tracked_field(pass.model, OPACITIES).ok_or_else(|| OpError::Argument {
            op: "ImprovedGs::loss_terms",
            what: format!("the model has no field `{OPACITIES}`"),
        })?;
        let presses = self.selection.is_on() && times.presses(pass.at.step);
        Ok(vec![match presses {
            true => pressure(
                logits.flatten(0, 1),
                self.selection.weight,
                times.is_early(pass.at.step),
            ),
            false => Tensor::zeros([1], (&logits.device(), logits.dtype())),
        }])
    }

    fn field_step(&self, at: &StepInfo, field: &Field) -> FieldStep {
        // Counted from the end of the run, so that no gradient is left over.
        let left = at.run.steps.saturating_sub(at.step + 1);
        if !left.is_multiple_of(self.steps_per_update(at)) {
            return FieldStep::Accumulate;
        }
        let hastens = self
            .selecting(at)
            .is_some_and(|(times, _)| self.selection.hastens(&times, at.step));
        FieldStep::Step(match field.name == OPACITIES && hastens {
            true => self.settings.selection.opacity_rate,
            false => 1.0,
        })
    }

    fn before_step(&mut self, context: &mut StepContext<M>) -> Result<(), OpError> {
        let _span = trace_span!("density").entered();
        (context.screen.iter())
            .try_for_each(|view| self.sums.add(view, view.absgrad.as_ref(), None))
    }

    fn after_step(&mut self, context: &mut StepContext<M>) -> Result<Option<Refinement>, OpError> {
        if context.at.step < self.growth(&context.at).stop {
            return self.grow(context);
        }
        self.sums.clear();
        self.select(context)
    }

    fn save(&self) -> Result<StateRecord, OpError> {
        let mut record = self.sums.save()?;
        self.selection.save(&mut record);
        Ok(record)
    }

    fn restore(
        &mut self,
        mut record: StateRecord,
        rows: usize,
        device: &Device,
    ) -> Result<(), String> {
        self.selection = Selection::restore(&mut record)?;
        self.sums = ScreenSums::restore(record, rows, device)?;
        Ok(())
    }
}
