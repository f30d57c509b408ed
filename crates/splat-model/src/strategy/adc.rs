//! Adaptive density control of 3DGS (section 5.2), with the defaults of gsplat.

use burn::tensor::{Device, Tensor, TensorData};
use derive_setters::Setters;
use glam::{Quat, Vec3};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};
use splat_ops::device::to_host;
use splat_ops::{OpError, ScreenStatistics};
use tracing::trace_span;

use super::{Refinement, ScreenView, ScreenWants, StepContext, StepInfo, Strategy};
use crate::optimizer::StateRecord;
use crate::rows::{Moments, RowEdit};
use crate::{Field, Optimized, SplatModel};

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
    /// A Gaussian is cloned or split when its mean screen gradient exceeds this, in half images.
    /// Default 2e-4.
    pub grow_gradient: f64,
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
}

impl Default for AdcSettings {
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

/// The numbers that are decided on, on the host.
#[derive(Debug, Clone, Default)]
struct Splats {
    means: Vec<[f32; 3]>,
    log_scales: Vec<[f32; 3]>,
    quats: Vec<[f32; 4]>,
    opacity_logits: Vec<f32>,
}

impl Splats {
    /// 11 numbers of each Gaussian.
    fn read<M: SplatModel>(model: &Optimized<M>) -> Result<Self, OpError> {
        let [means, log_scales, quats, opacity_logits] =
            model.read(["means", "log_scales", "quats", "opacity_logits"])?;
        Ok(Self {
            means: means.as_chunks().0.to_vec(),
            log_scales: log_scales.as_chunks().0.to_vec(),
            quats: quats.as_chunks().0.to_vec(),
            opacity_logits,
        })
    }

    fn len(&self) -> usize {
        self.means.len()
    }
}

/// The strategy of 3DGS: Gaussians whose screen gradients are large are cloned or split, faint and
/// large ones removed, and opacities reset now and then.
#[derive(Debug, Clone)]
pub struct Adc {
    settings: AdcSettings,
    /// Per Gaussian, sum of screen gradients and number of views that saw it, since the last
    /// refinement.
    statistics: Option<ScreenStatistics>,
}

impl Adc {
    /// A strategy for one run. Without `max_gaussians` nothing limits growth; the trainer's own,
    /// which it makes where no strategy is given, takes a limit from the photos.
    pub fn new(settings: AdcSettings) -> Self {
        Self {
            settings,
            statistics: None,
        }
    }

    /// Takes in a view: its splats, and the gradient `[C, N, 9]` of their packed rows.
    fn observe(&mut self, view: &ScreenView) -> Result<(), OpError> {
        let Some(gradient) = view.gradient.clone() else {
            return Ok(());
        };
        let [_, n, _] = gradient.dims();
        let before = self
            .statistics
            .take()
            .filter(|sums| sums.views.dims() == [n]);
        let before = before.unwrap_or_else(|| {
            let zeros = Tensor::zeros([n], (&gradient.device(), gradient.dtype()));
            ScreenStatistics {
                gradients: zeros.clone(),
                views: zeros,
            }
        });
        self.statistics = Some(before.add(gradient, &view.projected)?);
        Ok(())
    }

    /// Decides, from plain values: clones first, then splits, then what is pruned of it all.
    fn plan(&self, at: &StepInfo, splats: &Splats, gradients: &[f64]) -> (RowEdit, Refinement) {
        let (mut edit, mut report) = self.grow(at, splats, gradients);
        let settings = &self.settings;
        let prunes_large = at.step > settings.prune_scale_start;
        let before = edit.len();
        let sources = edit.sources();
        let keeps = |row: usize| {
            let source = sources[row] as usize;
            let shrunk = edit
                .offset_of(row, "log_scales")
                .map_or(0.0, |offset| offset[0]);
            let opacity = 1.0 / (1.0 + f64::from(-splats.opacity_logits[source]).exp());
            let large = scale(at, splats, source) * f64::from(shrunk).exp() > settings.prune_scale;
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
    fn grow(&self, at: &StepInfo, splats: &Splats, gradients: &[f64]) -> (RowEdit, Refinement) {
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
        let smaller = -(1.6f32.ln());
        for row in &splits {
            for half in 0..2 {
                let new = edit.push(*row, Moments::Restart);
                edit.offset(new, "means", &sample(at, *row, half, splats));
                edit.offset(new, "log_scales", &[smaller; 3]);
            }
        }
        let report = Refinement {
            cloned: clones.len(),
            split: splits.len(),
            ..Refinement::default()
        };
        (edit, report)
    }

    /// The rows that grow, in order. Where not all can, those do that need it most.
    fn growing(&self, splats: &Splats, gradients: &[f64]) -> Vec<usize> {
        let settings = &self.settings;
        let most = settings.max_gaussians.unwrap_or(usize::MAX);
        let room = most.saturating_sub(splats.len());
        let mut growing: Vec<usize> = (0..splats.len())
            .filter(|row| gradients[*row] > settings.grow_gradient)
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
        let needed = ["means", "log_scales", "quats", "opacity_logits"];
        let has = |name: &&str| fields.iter().any(|field| field.name == **name);
        if let Some(name) = needed.iter().find(|name| !has(name)) {
            return Err(format!("adaptive density control needs a field `{name}`"));
        }
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
        if at.step < at.run.milestone(self.settings.stop) {
            ScreenWants::gradients()
        } else {
            ScreenWants::nothing()
        }
    }

    fn before_step(&mut self, context: &mut StepContext<M>) -> Result<(), OpError> {
        let _span = trace_span!("density").entered();
        context
            .screen
            .iter()
            .try_for_each(|view| self.observe(view))
    }

    fn after_step(&mut self, context: &mut StepContext<M>) -> Result<Option<Refinement>, OpError> {
        let StepInfo { step, run } = context.at;
        let settings = &self.settings;
        let stop = run.milestone(settings.stop);
        if step > stop {
            self.statistics = None;
            return Ok(None);
        }
        let (resets, reset_opacity) = (
            step.is_multiple_of(settings.reset_every) && step < stop,
            settings.reset_opacity,
        );
        let start = settings.start.min(run.steps / 4);
        let due = step > start && step.is_multiple_of(settings.every);
        let mut report = None;
        if due && let Some(sums) = self.statistics.take() {
            let gradients = mean_gradients(sums)?;
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
        let mut record = StateRecord::default();
        if let Some(sums) = self.statistics.clone() {
            for (name, sum) in [(GRADIENTS, sums.gradients), (VIEWS, sums.views)] {
                let values = to_host(sum)?;
                let count = values.len();
                let data = TensorData::new(values, [count]);
                record.tensors.insert(name.to_owned(), data);
            }
        }
        Ok(record)
    }

    fn restore(
        &mut self,
        mut record: StateRecord,
        rows: usize,
        device: &Device,
    ) -> Result<(), String> {
        let taken = [GRADIENTS, VIEWS].map(|name| record.tensors.remove(name));
        if let Some(name) = record.tensors.keys().chain(record.scalars.keys()).next() {
            return Err(format!("`{name}` is nothing that density control keeps"));
        }
        self.statistics = match taken {
            [None, None] => None,
            [Some(gradients), Some(views)] => {
                if [&gradients, &views]
                    .iter()
                    .any(|sum| sum.shape()[..] != [rows])
                {
                    return Err(format!("its sums must have shape [{rows}]"));
                }
                let [gradients, views] =
                    [gradients, views].map(|sum| Tensor::from_data(sum, device));
                Some(ScreenStatistics { gradients, views })
            }
            _ => return Err(format!("of `{GRADIENTS}` and `{VIEWS}` one is missing")),
        };
        Ok(())
    }
}

/// The largest scale of a Gaussian, in sizes of the scene.
fn scale(at: &StepInfo, splats: &Splats, row: usize) -> f64 {
    let largest = splats.log_scales[row].into_iter().fold(f32::MIN, f32::max);
    f64::from(largest).exp() / at.run.scene_scale.length()
}

/// A draw from the Gaussian around its mean, from (seed, step, row, half) alone.
fn sample(at: &StepInfo, row: usize, half: u64, splats: &Splats) -> [f32; 3] {
    let id = (row as u64) * 2 + half;
    let seed = at.run.seed ^ (at.step as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
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

/// Names in a checkpoint.
const GRADIENTS: &str = "gradients";
const VIEWS: &str = "views";

/// Mean screen gradient of each Gaussian over the views that saw it.
fn mean_gradients(sums: ScreenStatistics) -> Result<Vec<f64>, OpError> {
    let gradients = to_host(sums.gradients)?.into_iter();
    let mean = |(total, views): (f32, f32)| f64::from(total) / f64::from(views.max(1.0));
    Ok(gradients.zip(to_host(sums.views)?).map(mean).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

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
            log_scales: [0.01f32, 0.01, 0.1, 0.01].map(|s| [s.ln(); 3]).to_vec(),
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
        assert!(
            smaller
                .iter()
                .all(|x| (f64::from(*x) + 1.6f64.ln()).abs() < 1e-6)
        );
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
    fn large_ones_are_pruned_only_later() {
        let mut splats = splats();
        splats.log_scales[0] = [0.5f32.ln(); 3];
        let density = Adc::new(AdcSettings::default());
        let pruned = |step| density.plan(&at(step), &splats, &[0.0; 4]).1.pruned;
        assert_eq!((pruned(600), pruned(3_100)), (1, 2));
    }

    #[cfg(feature = "cpu")]
    #[test]
    fn a_gradient_that_is_not_finite_does_not_hide_other_views() {
        let device = burn::tensor::Device::flex();
        let mut density = Adc::new(AdcSettings::default());
        let size = splat_ops::ImageSize {
            width: 2,
            height: 2,
        };
        for x in [3.0, f32::NAN, f32::INFINITY, 1.0] {
            let [first, second] = [x, 2.0].map(|x| [x, 0.0, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0]);
            let gradient = Tensor::<3>::from_floats([[first, second]], &device);
            let packed = Tensor::ones([1, 2, 9], &device);
            let view = ScreenView {
                view: 0,
                projected: splat_ops::Projected::from_packed(packed, size).unwrap(),
                gradient: Some(gradient),
            };
            density.observe(&view).unwrap();
        }
        let saved = Strategy::<crate::Gaussians>::save(&density).unwrap();
        let values = |name: &str| saved.tensors[name].try_to_vec::<f32>().unwrap();
        assert_eq!(values(super::GRADIENTS), [4.0, 8.0]);
        assert_eq!(values(super::VIEWS), [4.0, 4.0]);
    }
}
