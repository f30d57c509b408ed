//! Natural selection of fewer Gaussians after growth (Deng et al. 2025, *Gradient-Driven Natural
//! Selection for Compact 3D Gaussian Splatting*): a pressure on all opacities alike, against which
//! the photos hold those that they need.

use burn::tensor::Tensor;
use burn::tensor::activation::sigmoid as sigmoid_of;
use burn_pack::Scalar;
use derive_setters::Setters;
use serde::{Deserialize, Serialize};

use crate::optimizer::StateRecord;
use crate::strategy::RunSchedule;

/// Settings of natural selection, in [`ImprovedGsSettings`](super::ImprovedGsSettings). It begins
/// where growth ends.
///
/// ```
/// use splat_model::strategy::{ImprovedGs, ImprovedGsSettings, SelectionSettings};
///
/// // Grows to 90,000 Gaussians, of which 30,000 survive.
/// let selection = SelectionSettings::new().with_final_gaussians(30_000);
/// let strategy = ImprovedGs::new(ImprovedGsSettings::new().with_selection(selection));
/// # let _ = strategy;
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Setters)]
#[serde(default, deny_unknown_fields)]
#[setters(prefix = "with_", strip_option)]
pub struct SelectionSettings {
    /// How many Gaussians survive. Default: all, without selection.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub final_gaussians: Option<usize>,
    /// Growth ends at this multiple of them, or at `max_gaussians` where that is less. Default 3.
    pub overgrowth: f64,
    /// Instead of `final_gaussians`: the share of `max_gaussians` that survives. Growth then ends
    /// at `max_gaussians`. Default none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub final_share: Option<f64>,
    /// Milestone: selection ends by this step. Default 23,000.
    pub stop: usize,
    /// Weight of the pressure in the loss at first; it is controlled so that opacities fall in
    /// time. Default 2e-4.
    pub weight: f64,
    /// Factor of the opacities' learning rate during selection and for an eighth of its time after
    /// it. Default 4.
    pub opacity_rate: f64,
    /// Below this opacity a Gaussian has not survived. Default 1/255, below which it is never drawn
    /// and no photo can raise it again (0.001 in GNS, whose survivors may be such).
    pub prune_opacity: f64,
}

impl Default for SelectionSettings {
    fn default() -> Self {
        Self {
            final_gaussians: None,
            overgrowth: 3.0,
            final_share: None,
            stop: 23_000,
            weight: 2e-4,
            opacity_rate: 4.0,
            prune_opacity: 1.0 / 255.0,
        }
    }
}

impl SelectionSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }

    /// To how many Gaussians growth goes, if there is a selection.
    pub(super) fn grown(&self) -> Option<usize> {
        let count = self.final_gaussians?;
        Some((count as f64 * self.overgrowth) as usize)
    }

    /// How many survive, if there is a selection, given the limit of growth.
    pub(super) fn survivors(&self, most: Option<usize>) -> Option<usize> {
        let shared = || Some(((self.final_share? * most? as f64) as usize).max(1));
        self.final_gaussians.or_else(shared)
    }

    /// Checks that the settings can be used beside this limit of growth.
    pub(super) fn validate(&self, most: Option<usize>) -> Result<(), String> {
        if let Some(count) = self.final_gaussians {
            if count == 0 {
                return Err("`final_gaussians` must be at least 1".to_owned());
            }
            if let Some(most) = most.filter(|most| *most <= count) {
                return Err(format!(
                    "`final_gaussians` {count} must be below `max_gaussians` {most}, or there is nothing to select from"
                ));
            }
        }
        if let Some(share) = self.final_share {
            if !(share > 0.0 && share < 1.0) {
                return Err(format!("`final_share` must lie in (0, 1), it is {share}"));
            }
            if self.final_gaussians.is_some() {
                return Err("`final_share` and `final_gaussians` say the same; give one".to_owned());
            }
        }
        let factors = [
            ("overgrowth", self.overgrowth, 1.0, 100.0),
            ("opacity_rate", self.opacity_rate, 1e-3, 100.0),
            ("weight", self.weight, 0.0, 1.0),
        ];
        let fits = |value: f64, least: f64, most: f64| (least..=most).contains(&value);
        if let Some((name, value, least, most)) =
            (factors.iter()).find(|(_, value, least, most)| !fits(*value, *least, *most))
        {
            return Err(format!(
                "`{name}` must lie in [{least}, {most}], it is {value}"
            ));
        }
        if !(0.0..=0.1).contains(&self.prune_opacity) {
            let prune = self.prune_opacity;
            return Err(format!(
                "`prune_opacity` must lie in [0, 0.1], it is {prune}: what is opaque is not to be removed"
            ));
        }
        Ok(())
    }
}

/// Pressure acts in one step of so many, or of fewer in shorter runs.
const LONGEST_INTERVAL: usize = 50;
/// Though not of fewer than the first moment of Adam takes to forget most of it.
const SHORTEST_INTERVAL: usize = 10;
/// So many intervals fit between the beginning and the end, where they are not too short.
const INTERVALS: usize = 160;
/// Opacity of a logit that nothing needs: the pressure is that of a spring whose rest is there.
const REST: f64 = -20.0;
/// Selection is over with so many more than survive; the rest is drawn.
const NEARLY: f64 = 1.05;

/// When selection acts, in steps of one run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Times {
    pub(super) start: usize,
    pub(super) stop: usize,
    interval: usize,
    /// An eighth of its time. Pressure is even and the faint are removed after it; opacities are
    /// to be gone this long before the end.
    eighth: usize,
}

impl Times {
    pub(super) fn new(settings: &SelectionSettings, growth_stop: usize, run: &RunSchedule) -> Self {
        let stop = run.milestone(settings.stop).max(growth_stop);
        let time = stop - growth_stop;
        Self {
            start: growth_stop,
            stop,
            interval: (time / INTERVALS).clamp(SHORTEST_INTERVAL, LONGEST_INTERVAL),
            eighth: time / 8,
        }
    }

    fn is_within(&self, step: usize) -> bool {
        (self.start..self.stop).contains(&step)
    }

    fn is_multiple(&self, step: usize, intervals: usize) -> bool {
        (step - self.start).is_multiple_of(intervals * self.interval)
    }

    /// Whether pressure acts in the step after so many.
    pub(super) fn presses(&self, step: usize) -> bool {
        self.is_within(step) && self.is_multiple(step, 1)
    }

    /// Whether the weight is controlled before that step.
    pub(super) fn controls(&self, step: usize) -> bool {
        self.is_within(step) && step > self.start && self.is_multiple(step, 2)
    }

    /// Whether it is the first part of the time, in which pressure is stronger on what is opaque.
    pub(super) fn is_early(&self, step: usize) -> bool {
        step < self.start + self.eighth
    }

    /// Whether the faint are removed after so many steps.
    pub(super) fn prunes(&self, step: usize) -> bool {
        self.is_within(step) && !self.is_early(step) && self.is_multiple(step, 1)
    }

    /// Share of the opacity at the start that is to be left after so many steps.
    fn goal(&self, step: usize) -> f64 {
        let time = (self.stop - self.start - self.eighth).max(1);
        (1.0 - step.saturating_sub(self.start) as f64 / time as f64).max(0.0)
    }
}

/// The pressure: a loss of the logits `l` of all opacities `o`, of shape `[1]`.
///
/// ```text
/// λ mean((l + 20) / max(0.05, 1 - o))²   early
/// 3 λ (mean(l) + 20)²                    then
/// ```
pub(in super::super) fn pressure(logits: Tensor<1>, weight: f64, early: bool) -> Tensor<1> {
    let raised = logits.clone() - REST;
    if early {
        // 1 - o, without the loss of digits where o is near 1.
        let spare = sigmoid_of(logits.neg()).clamp_min(0.05);
        (raised / spare).mean().square() * weight
    } else {
        raised.mean().square() * (3.0 * weight)
    }
}

/// The state of selection.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Selection {
    /// Weight of the pressure, λ.
    pub(super) weight: f64,
    /// Four fifths of the opacity, at the start, of the last that is to survive.
    reference: Option<f64>,
    /// The step after which it was over.
    ended: Option<usize>,
}

/// Names in a checkpoint.
const WEIGHT: &str = "selection_weight";
const REFERENCE: &str = "selection_reference_opacity";
const ENDED: &str = "selection_ended";

impl Selection {
    pub(super) fn new(settings: &SelectionSettings) -> Self {
        Self {
            weight: settings.weight,
            reference: None,
            ended: None,
        }
    }

    /// Whether pressure can act.
    pub(super) fn is_on(&self) -> bool {
        self.reference.is_some() && self.ended.is_none()
    }

    pub(super) fn is_over(&self) -> bool {
        self.ended.is_some()
    }

    pub(super) fn end(&mut self, step: usize) {
        self.ended = Some(step);
    }

    /// Whether so many Gaussians after so many steps are few enough, or it is time.
    pub(super) fn ends(&self, times: &Times, step: usize, count: usize, survivors: usize) -> bool {
        (count as f64) < NEARLY * survivors as f64 || step >= times.stop
    }

    /// Begins, or controls the weight, given the opacity of the last that is to survive.
    pub(super) fn control(&mut self, times: &Times, step: usize, opacity: f64) {
        let Some(reference) = self.reference else {
            self.reference = Some(0.8 * opacity);
            return;
        };
        let goal = times.goal(step) * reference;
        if opacity < 0.9 * goal {
            self.weight *= 0.8;
        } else if opacity > 1.1 * goal {
            self.weight *= 1.2;
        }
    }

    /// Whether opacities are learned faster in the step after so many.
    pub(super) fn hastens(&self, times: &Times, step: usize) -> bool {
        let rest = |ended: usize| step < ended + times.eighth;
        self.reference.is_some() && self.ended.is_none_or(rest)
    }

    pub(super) fn save(&self, record: &mut StateRecord) {
        let numbers = [
            (WEIGHT, Some(Scalar::Float(self.weight))),
            (REFERENCE, self.reference.map(Scalar::Float)),
            (ENDED, self.ended.map(|step| Scalar::UInt(step as u64))),
        ];
        for (name, number) in numbers {
            if let Some(number) = number {
                record.scalars.insert(name.to_owned(), number);
            }
        }
    }

    /// Takes from a record what [`save`](Self::save) put there.
    pub(super) fn restore(record: &mut StateRecord) -> Result<Self, String> {
        let mut take = |name: &str| record.scalars.remove(name);
        let float = |name: &str, value: Scalar| match value {
            Scalar::Float(value) if value.is_finite() => Ok(value),
            other => Err(format!("`{name}` is {other:?}, which is no finite number")),
        };
        let weight = take(WEIGHT).ok_or_else(|| format!("`{WEIGHT}` is missing"))?;
        let reference = take(REFERENCE);
        let ended = take(ENDED).map(usize::try_from).transpose();
        Ok(Self {
            weight: float(WEIGHT, weight)?,
            reference: reference.map(|value| float(REFERENCE, value)).transpose()?,
            ended: ended.map_err(|_| format!("`{ENDED}` is no step"))?,
        })
    }
}

/// The opacity of the last of so many survivors, given all. That of the faintest where there are
/// fewer.
pub(super) fn last_survivor(mut opacities: Vec<f64>, survivors: usize) -> f64 {
    let place = survivors.min(opacities.len()).saturating_sub(1);
    if opacities.is_empty() {
        return 0.0;
    }
    *(opacities.select_nth_unstable_by(place, |a, b| b.total_cmp(a))).1
}

#[cfg(test)]
mod tests {
    use super::*;

    fn times(steps: usize) -> Times {
        let run = RunSchedule {
            steps,
            scene_scale: splat_data::SceneScale::new(1.0).unwrap(),
            seed: 1,
        };
        Times::new(&SelectionSettings::new(), run.milestone(15_000), &run)
    }

    fn steps(of: usize, is: impl Fn(usize) -> bool) -> Vec<usize> {
        (0..of).filter(|step| is(*step)).collect()
    }

    #[test]
    fn a_long_run_presses_as_the_paper_does() {
        let times = times(30_000);
        let presses = steps(30_000, |step| times.presses(step));
        assert_eq!(
            (presses[0], presses[1], presses.len()),
            (15_000, 15_050, 160)
        );
        assert_eq!(steps(30_000, |step| times.controls(step))[0], 15_100);
        assert_eq!(steps(30_000, |step| times.prunes(step))[0], 16_000);
        assert!(times.is_early(15_999) && !times.is_early(16_000));
        assert_eq!((times.goal(15_000), times.goal(18_500)), (1.0, 0.5));
        assert_eq!((times.goal(22_000), times.goal(23_000)), (0.0, 0.0));
    }

    /// A short run has fewer, but not a handful.
    #[test]
    fn short_runs_press_often_enough() {
        for (run, least) in [(1_000, 26), (2_000, 50), (7_000, 160)] {
            let times = times(run);
            let presses = steps(run, |step| times.presses(step));
            assert!(presses.len() >= least, "{run}: {}", presses.len());
            assert!(times.stop < run * 8 / 10);
        }
    }

    #[test]
    fn the_weight_follows_the_opacity_of_the_last_survivor() {
        let (times, settings) = (times(30_000), SelectionSettings::new());
        let mut selection = Selection::new(&settings);
        assert!(!selection.is_on());
        selection.control(&times, 15_000, 0.5);
        assert_eq!((selection.reference, selection.weight), (Some(0.4), 2e-4));
        // Half of 0.4 is the goal.
        for (opacity, factor) in [(0.2, 1.0), (0.17, 0.8), (0.23, 1.2), (0.19, 1.0)] {
            let before = selection.weight;
            selection.control(&times, 18_500, opacity);
            assert_eq!(selection.weight, before * factor);
        }
        assert!(selection.hastens(&times, 22_999));
        selection.end(20_000);
        assert!(selection.hastens(&times, 20_999) && !selection.hastens(&times, 21_000));
    }

    /// Against `tests/fixtures/improved.py`, in a run of 30,000 steps.
    #[test]
    fn control_agrees_with_pytorch() {
        let file = splat_test_support::Reference::read("strategies/gns_control");
        let last = last_survivor(
            file.values("opacities").to_vec(),
            file.number("survivors") as usize,
        );
        let weight = file.number("weight");
        let settings = SelectionSettings::new().with_weight(weight);
        let (times, mut selection) = (times(30_000), Selection::new(&settings));
        selection.control(&times, 15_000, last);
        assert_eq!(selection.reference, Some(file.number("reference")));
        let looks = file.values("progress").iter().zip(file.values("last"));
        for ((progress, opacity), expected) in looks.zip(file.values("weights")) {
            selection.control(&times, 15_000 + *progress as usize, *opacity);
            let error = (selection.weight / expected - 1.0).abs();
            assert!(error < 1e-12, "after {progress}: {error:e}");
        }
    }

    #[test]
    fn the_last_survivor_is_the_faintest_of_the_strongest() {
        let opacities = vec![0.3, 0.9, 0.1, 0.7];
        for (survivors, expected) in [(1, 0.9), (3, 0.3), (4, 0.1), (9, 0.1)] {
            assert_eq!(last_survivor(opacities.clone(), survivors), expected);
        }
        assert_eq!(last_survivor(Vec::new(), 3), 0.0);
    }

    #[test]
    fn its_state_is_kept() {
        let mut selection = Selection::new(&SelectionSettings::new());
        let times = times(30_000);
        for step in [15_000, 15_100] {
            let mut record = StateRecord::default();
            selection.save(&mut record);
            assert_eq!(Selection::restore(&mut record), Ok(selection));
            assert_eq!(record, StateRecord::default());
            selection.control(&times, step, 0.3);
        }
        selection.end(15_200);
        let mut record = StateRecord::default();
        selection.save(&mut record);
        assert_eq!(Selection::restore(&mut record.clone()), Ok(selection));
        let bad = Scalar::Float(f64::NAN);
        record.scalars.insert(REFERENCE.to_owned(), bad);
        assert!(
            Selection::restore(&mut record)
                .unwrap_err()
                .contains(REFERENCE)
        );
    }
}
