//! Gaussians as samples (Kheradmand et al. 2024, *3D Gaussian Splatting as Markov Chain Monte
//! Carlo*), with the defaults and the order of operations of gsplat.

use burn::tensor::Tensor;
use derive_setters::Setters;
use serde::{Deserialize, Serialize};
use splat_ops::{OpError, Perturbation, perturb_means};

use super::relocation::relocate_logit;
use super::{Pass, Refinement, StepContext, StepInfo, Strategy, check_fields, draw};
use crate::opacity::sigmoid;
use crate::rows::{Moments, RowEdit};
use crate::{Field, InitSettings, Optimized, SplatModel};

/// Settings of [`Mcmc`]. Milestones are stated for a run of 30,000 steps and shrink with shorter
/// runs; intervals do not. Lengths are in units of the scene's size, so that a capture in another
/// unit gives the same result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Setters)]
#[serde(default, deny_unknown_fields)]
#[setters(prefix = "with_", strip_option)]
pub struct McmcSettings {
    /// Gaussians are moved and added after this step, or after a quarter of the run where that is
    /// sooner. Default 500.
    pub start: usize,
    /// Milestone: none is moved or added from this step on. Default 25,000.
    pub stop: usize,
    /// Interval: steps between two times that Gaussians are moved and added. Default 100.
    pub every: usize,
    /// Each time, as many are added as make this the factor of growth. Default 1.05.
    pub growth: f64,
    /// No growth beyond this many Gaussians. Default: none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_gaussians: Option<usize>,
    /// A Gaussian whose opacity is not above this is dead: it is moved to where one is needed.
    /// Default 0.005.
    pub min_opacity: f64,
    /// Size of the noise, in learning rates of the means. Default 5e5.
    pub noise: f64,
    /// Opacity at which half of the noise is left. Default 0.005.
    pub noise_opacity: f64,
    /// How steeply the noise falls with the opacity. Default 100.
    pub noise_steepness: f64,
    /// Weight of the mean opacity in the loss. Default 0.01.
    pub opacity_weight: f64,
    /// Weight of the mean scale in the loss. Default 0.01.
    pub scale_weight: f64,
    /// Opacity of the first Gaussians, instead of the run's. Default 0.5.
    pub init_opacity: f64,
    /// Factor of the scales of the first Gaussians, instead of the run's. Default 0.1.
    pub init_scale: f64,
}

impl McmcSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }
}

impl Default for McmcSettings {
    fn default() -> Self {
        Self {
            start: 500,
            stop: 25_000,
            every: 100,
            growth: 1.05,
            max_gaussians: None,
            min_opacity: 0.005,
            noise: 5e5,
            noise_opacity: 0.005,
            noise_steepness: 100.0,
            opacity_weight: 0.01,
            scale_weight: 0.01,
            init_opacity: 0.5,
            init_scale: 0.1,
        }
    }
}

/// More copies of one Gaussian at once are treated as this many, as gsplat's table of binomials
/// has it.
const MOST_COPIES: usize = 51;

/// The strategy of 3DGS-MCMC: Gaussians that became transparent are moved to where others are, more
/// are added there up to a cap, and after every step noise lets transparent ones wander. Terms of
/// the loss press on opacities and scales, so that what is not needed dies.
///
/// It keeps no statistics, and no state beside its settings.
///
/// ```
/// use splat_model::strategy::{Mcmc, McmcSettings};
///
/// let strategy = Mcmc::new(McmcSettings::new().with_max_gaussians(100_000));
/// # let _ = strategy;
/// ```
#[derive(Debug, Clone)]
pub struct Mcmc {
    settings: McmcSettings,
}

impl Mcmc {
    /// A strategy for one run. Without `max_gaussians` nothing limits growth; the trainer takes a
    /// limit from the photos for those that it makes itself.
    pub fn new(settings: McmcSettings) -> Self {
        Self { settings }
    }

    /// The noise after a step, given the learning rate of the means.
    fn perturbation(&self, at: &StepInfo, rate: f64) -> Perturbation {
        let size = at.run.scene_scale.length();
        Perturbation {
            // The rate is a length; noise relative to the scene is that of a scene of size one.
            amount: self.settings.noise * rate / (size * size),
            opacity: self.settings.noise_opacity,
            steepness: self.settings.noise_steepness,
            seed: at.run.seed,
            step: at.step as u32,
        }
    }

    fn perturb<M: SplatModel>(
        &self,
        at: &StepInfo,
        model: &mut Optimized<M>,
    ) -> Result<(), OpError> {
        let means = model.fields().iter().find(|field| field.name == "means");
        let rate = means.map_or(0.0, |field| {
            field.rate_at(at.step, at.run.steps, at.run.scene_scale)
        });
        self.perturb_at_rate(at, rate, model)
    }

    /// The same, given the learning rate of the means.
    pub(super) fn perturb_at_rate<M: SplatModel>(
        &self,
        at: &StepInfo,
        rate: f64,
        model: &mut Optimized<M>,
    ) -> Result<(), OpError> {
        let noise = self.perturbation(at, rate);
        let fields = ["means", "quats", "log_scales", "opacity_logits"];
        let [Some(means), Some(quats), Some(log_scales), Some(logits)] =
            fields.map(|name| model.field(name))
        else {
            // `check` has seen to it that they are there.
            return Ok(());
        };
        let logits = logits.flatten::<1>(0, 1);
        let moved = perturb_means(means, quats, log_scales, logits, &noise)?;
        model.update("means", |_| moved)
    }
}

/// The rows of a model while they are moved and added.
#[derive(Debug, Clone)]
pub(super) struct Rows {
    edit: RowEdit,
    logits: Vec<f64>,
    log_scales: Vec<[f64; 3]>,
    /// Whether opacity and scales are others than those of the row's source.
    changed: Vec<bool>,
}

impl Rows {
    pub(super) fn new(opacity_logits: &[f64], log_scales: &[[f64; 3]]) -> Self {
        Self {
            edit: RowEdit::identity(opacity_logits.len()),
            logits: opacity_logits.to_vec(),
            log_scales: log_scales.to_vec(),
            changed: vec![false; opacity_logits.len()],
        }
    }

    pub(super) fn len(&self) -> usize {
        self.logits.len()
    }

    fn opacities(&self) -> Vec<f64> {
        self.logits.iter().map(|logit| sigmoid(*logit)).collect()
    }

    /// Gives each row that was chosen the opacity and the scales of the copies that it now is one
    /// of.
    fn share(&mut self, chosen: &[usize], min_opacity: f64) {
        let mut copies = vec![1usize; self.len()];
        for row in chosen {
            copies[*row] += 1;
        }
        let opacities = min_opacity..=1.0 - f64::from(f32::EPSILON);
        for (row, copies) in copies.into_iter().enumerate().filter(|(_, n)| *n > 1) {
            let copies = copies.min(MOST_COPIES);
            let (logit, factor) = relocate_logit(self.logits[row], copies, &opacities);
            self.logits[row] = logit;
            self.log_scales[row] = self.log_scales[row].map(|scale| scale + factor.ln());
            self.changed[row] = true;
        }
    }

    /// Moves each dead row to the living one chosen for it.
    pub(super) fn relocate(&mut self, dead: &[usize], chosen: &[usize], min_opacity: f64) {
        self.share(chosen, min_opacity);
        let sources = self.edit.sources();
        for (dead, row) in dead.iter().zip(chosen) {
            // The moments of the dead row stay where they are; those of the other start anew.
            let source = sources[*row] as usize;
            self.edit.relocate(*dead, source, Moments::Of(*dead));
            self.edit.set_moments(*row, Moments::Restart);
            self.logits[*dead] = self.logits[*row];
            self.log_scales[*dead] = self.log_scales[*row];
            self.changed[*dead] = true;
        }
    }

    /// Adds a copy of each row that was chosen.
    pub(super) fn add(&mut self, chosen: &[usize], min_opacity: f64) {
        self.share(chosen, min_opacity);
        let sources = self.edit.sources();
        for row in chosen {
            self.edit.push(sources[*row] as usize, Moments::Restart);
            self.logits.push(self.logits[*row]);
            self.log_scales.push(self.log_scales[*row]);
            self.changed.push(true);
        }
    }

    /// The edit with all values in it.
    pub(super) fn finish(mut self) -> RowEdit {
        for row in 0..self.len() {
            if self.changed[row] {
                self.edit.set(row, "opacity_logits", &[self.logits[row]]);
                self.edit.set(row, "log_scales", &self.log_scales[row]);
            }
        }
        self.edit
    }
}

/// Draws rows with replacement, each with a probability proportional to its weight: one for every
/// id. Nothing where all weights are zero.
fn sample(at: &StepInfo, weights: &[f64], ids: impl Iterator<Item = u64>) -> Vec<usize> {
    let mut total = 0.0;
    let sums: Vec<f64> = (weights.iter())
        .map(|weight| {
            total += if *weight > 0.0 { *weight } else { 0.0 };
            total
        })
        .collect();
    if !(total > 0.0) {
        return Vec::new();
    }
    let last = sums.partition_point(|sum| *sum < total);
    ids.map(|id| {
        let target = draw::uniform(at, id) * total;
        sums.partition_point(|sum| *sum <= target).min(last)
    })
    .collect()
}

/// Draws for rows that are added have ids from here on.
const ADDED: u64 = 1 << 40;

impl Mcmc {
    /// Moves dead Gaussians and adds others, from plain values.
    fn plan(
        &self,
        at: &StepInfo,
        opacity_logits: &[f64],
        log_scales: &[[f64; 3]],
    ) -> (RowEdit, Refinement) {
        let mut rows = Rows::new(opacity_logits, log_scales);
        let dead = self.dead(&rows);
        if dead.len() == rows.len() {
            // Copies of the dead would be dead.
            return (rows.finish(), Refinement::default());
        }
        let mut living = rows.opacities();
        dead.iter().for_each(|row| living[*row] = 0.0);
        let relocated = sample(at, &living, dead.iter().map(|row| *row as u64));
        rows.relocate(&dead, &relocated, self.settings.min_opacity);
        let ids = (0..self.room(rows.len()) as u64).map(|id| ADDED + id);
        let added = sample(at, &rows.opacities(), ids);
        rows.add(&added, self.settings.min_opacity);
        let report = Refinement {
            cloned: added.len(),
            relocated: relocated.len(),
            ..Refinement::default()
        };
        (rows.finish(), report)
    }

    /// The rows that are moved.
    pub(super) fn dead(&self, rows: &Rows) -> Vec<usize> {
        let opacities = rows.opacities();
        let is_dead = |row: &usize| !(opacities[*row] > self.settings.min_opacity);
        (0..rows.len()).filter(is_dead).collect()
    }

    /// How many rows are added to so many.
    pub(super) fn room(&self, rows: usize) -> usize {
        let grown = (rows as f64 * self.settings.growth) as usize;
        let most = self.settings.max_gaussians.unwrap_or(usize::MAX);
        grown.min(most).saturating_sub(rows)
    }
}

impl<M: SplatModel> Strategy<M> for Mcmc {
    /// With its settings, apart from the limit of growth, which a resumed run may change.
    fn name(&self) -> String {
        let settings = McmcSettings {
            max_gaussians: None,
            ..self.settings.clone()
        };
        format!("mcmc with {settings:?}")
    }

    fn check(&self, fields: &[Field]) -> Result<(), String> {
        check_fields("MCMC", fields)?;
        self.settings.validate()
    }

    fn first_gaussians(&self, settings: &InitSettings) -> InitSettings {
        InitSettings {
            opacity: self.settings.init_opacity,
            scale: self.settings.init_scale,
            ..settings.clone()
        }
    }

    fn loss_term_names(&self) -> Vec<String> {
        vec!["opacity".to_owned(), "scale".to_owned()]
    }

    /// The mean opacity, and the mean scale in sizes of the scene, weighted.
    fn loss_terms(&self, pass: &Pass<M>) -> Result<Vec<Tensor<1>>, OpError> {
        let size = pass.at.run.scene_scale.length();
        let opacity = pass.model.opacities().mean() * self.settings.opacity_weight;
        let scale = pass.model.scales().mean() * (self.settings.scale_weight / size);
        Ok(vec![opacity, scale])
    }

    fn after_step(&mut self, context: &mut StepContext<M>) -> Result<Option<Refinement>, OpError> {
        let StepInfo { step, run } = context.at;
        let settings = &self.settings;
        let start = run.start(settings.start);
        let stop = run.milestone(settings.stop);
        let mut report = None;
        if start < step && step < stop && step.is_multiple_of(settings.every) {
            let [means, log_scales, logits] =
                context
                    .model
                    .read_f64(["means", "log_scales", "opacity_logits"])?;
            let (mut edit, refinement) = self.plan(&context.at, &logits, log_scales.as_chunks().0);
            if refinement != Refinement::default() {
                edit.arrange(means.as_chunks().0);
                context.model.edit_rows(&edit)?;
            }
            report = Some(refinement);
        }
        self.perturb(&context.at, context.model)?;
        Ok(report)
    }
}

impl McmcSettings {
    /// Checks that the settings can be used.
    ///
    /// # Errors
    /// The field and why its value cannot be used, in one line.
    pub fn validate(&self) -> Result<(), String> {
        if self.every == 0 {
            return Err("`every` must be at least 1".to_owned());
        }
        if !(1.0..=2.0).contains(&self.growth) {
            let growth = self.growth;
            return Err(format!("`growth` must lie in [1, 2], it is {growth}"));
        }
        let shares = [
            ("min_opacity", self.min_opacity),
            ("noise_opacity", self.noise_opacity),
            ("init_opacity", self.init_opacity),
        ];
        if let Some((name, value)) = (shares.iter()).find(|(_, value)| !(0.0..1.0).contains(value))
        {
            return Err(format!("`{name}` must lie in [0, 1), it is {value}"));
        }
        if self.init_opacity <= self.min_opacity {
            return Err(format!(
                "`init_opacity` {} must be above `min_opacity` {}, or every Gaussian is dead from the start",
                self.init_opacity, self.min_opacity
            ));
        }
        // Beyond these, noise leaves nothing where it was, and the terms drown the photos.
        let sizes = [
            ("noise", self.noise, 1e8),
            ("noise_steepness", self.noise_steepness, 1e6),
            ("opacity_weight", self.opacity_weight, 1.0),
            ("scale_weight", self.scale_weight, 1.0),
        ];
        let fits = |value: f64, most: f64| (0.0..=most).contains(&value);
        if let Some((name, value, most)) =
            sizes.iter().find(|(_, value, most)| !fits(*value, *most))
        {
            return Err(format!("`{name}` must lie in [0, {most}], it is {value}"));
        }
        if !(0.0 < self.init_scale && self.init_scale <= 100.0) {
            let scale = self.init_scale;
            return Err(format!("`init_scale` must lie in (0, 100], it is {scale}"));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::opacity::logit;

    fn at(step: usize) -> StepInfo {
        let run = super::super::RunSchedule {
            steps: 30_000,
            scene_scale: splat_data::SceneScale::new(2.0).unwrap(),
            seed: 1,
        };
        StepInfo { step, run }
    }

    fn logits(opacities: &[f64]) -> Vec<f64> {
        opacities.iter().map(|opacity| logit(*opacity)).collect()
    }

    #[test]
    fn dead_ones_are_moved_and_keep_their_moments_and_sources_lose_theirs() {
        let settings = McmcSettings::new().with_max_gaussians(3);
        let opacities = logits(&[0.5, 0.001, 0.004]);
        let (edit, report) = Mcmc::new(settings).plan(&at(600), &opacities, &[[0.0; 3]; 3]);
        assert_eq!((report.relocated, report.cloned), (2, 0));
        assert_eq!(edit.sources(), [0, 0, 0]);
        let moments = [Moments::Restart, Moments::Of(1), Moments::Of(2)];
        assert_eq!(edit.moments(), moments);
        let changes = edit.changes();
        let set = &changes["opacity_logits"];
        assert_eq!(set.set_rows, [0, 1, 2]);
        // Three in one place look like the one that was there.
        for logit in &set.set_values {
            let opacity = sigmoid(*logit);
            assert!((1.0 - (1.0 - opacity).powi(3) - 0.5).abs() < 1e-12);
        }
    }

    #[test]
    fn growth_is_five_percent_up_to_the_cap() {
        let opacities = logits(&[0.5; 100]);
        let scales = [[0.0; 3]; 100];
        let grown = |settings: McmcSettings| {
            let (edit, report) = Mcmc::new(settings).plan(&at(600), &opacities, &scales);
            assert_eq!(edit.len(), 100 + report.cloned);
            report.cloned
        };
        assert_eq!(grown(McmcSettings::new()), 5);
        assert_eq!(grown(McmcSettings::new().with_max_gaussians(102)), 2);
        assert_eq!(grown(McmcSettings::new().with_max_gaussians(10)), 0);
    }

    #[test]
    fn rows_are_drawn_by_their_weight_and_never_without_one() {
        let weights = [0.0, 3.0, 0.0, 1.0, 0.0];
        let drawn = sample(&at(600), &weights, 0..40_000);
        let count = |row| drawn.iter().filter(|drawn| **drawn == row).count();
        assert_eq!(count(1) + count(3), 40_000);
        // Five standard errors.
        assert!(count(1).abs_diff(30_000) < 433, "{}", count(1));
        assert!(sample(&at(600), &[0.0, f64::NAN], 0..3).is_empty());
    }

    #[test]
    fn a_model_whose_every_gaussian_is_dead_stays_as_it_is() {
        let opacities = logits(&[1e-3; 4]);
        let settings = McmcSettings::new().with_growth(2.0);
        let (_, report) = Mcmc::new(settings).plan(&at(600), &opacities, &[[0.0; 3]; 4]);
        assert_eq!(report, Refinement::default());
    }

    #[test]
    fn opaque_ones_and_many_copies_stay_finite() {
        let mut opacities = vec![f64::INFINITY];
        opacities.extend(logits(&[1e-3; 80]));
        let scales = vec![[-1.0; 3]; 81];
        let settings = McmcSettings::new().with_max_gaussians(81);
        let (edit, report) = Mcmc::new(settings).plan(&at(600), &opacities, &scales);
        assert_eq!(report.relocated, 80);
        for changes in edit.changes().values() {
            assert!(changes.set_values.iter().all(|value| value.is_finite()));
        }
    }

    #[test]
    fn settings_out_of_range_are_named() {
        let problem = |settings: McmcSettings| settings.validate().unwrap_err();
        assert!(McmcSettings::new().validate().is_ok());
        for (name, settings) in [
            ("every", McmcSettings::new().with_every(0)),
            ("growth", McmcSettings::new().with_growth(f64::NAN)),
            ("min_opacity", McmcSettings::new().with_min_opacity(1.0)),
            ("init_opacity", McmcSettings::new().with_init_opacity(0.001)),
            ("noise", McmcSettings::new().with_noise(1e300)),
            (
                "opacity_weight",
                McmcSettings::new().with_opacity_weight(1e4),
            ),
            ("scale_weight", McmcSettings::new().with_scale_weight(-1.0)),
            ("init_scale", McmcSettings::new().with_init_scale(0.0)),
        ] {
            let message = problem(settings);
            assert!(message.contains(&format!("`{name}`")), "{message}");
        }
    }
}
