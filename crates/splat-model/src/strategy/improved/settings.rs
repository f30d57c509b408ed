//! Settings of Improved-GS.

use derive_setters::Setters;
use serde::{Deserialize, Serialize};

use super::selection::SelectionSettings;

/// Settings of [`ImprovedGs`](super::ImprovedGs). Milestones are stated for a run of 30,000 steps
/// and shrink with shorter runs. Intervals do not, unless they say so.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Setters)]
#[serde(default, deny_unknown_fields)]
#[setters(prefix = "with_", strip_option)]
pub struct ImprovedGsSettings {
    /// Gaussians are split after this step, or after a quarter of the run where that is sooner.
    /// Default 500.
    pub start: usize,
    /// Milestone: none is split or removed from this step on. Default 15,000.
    pub stop: usize,
    /// Interval: steps between refinements. In shorter runs a tenth of the time from `start` to
    /// `stop`, though not fewer than 50, in which gradients of that many views are averaged.
    /// Default 100.
    pub every: usize,
    /// After so many steps, or at `start` where that is sooner, what is faint is removed: points of
    /// the capture that no photo needs. Default 300.
    pub early_prune: usize,
    /// Below this opacity a Gaussian is removed then. Default 0.02.
    pub early_prune_opacity: f64,
    /// A Gaussian may be split when its mean absolute screen gradient is at least this, in half
    /// images. Default 3e-4.
    pub grow_gradient: f64,
    /// Interval: for so many steps before `stop`, or a quarter of the time from `start` to `stop`
    /// where that is less, growth fills what is left of the limit. Default 500.
    pub fill: usize,
    /// The threshold of gradients in that time. Default 2e-4.
    pub fill_gradient: f64,
    /// Training views whose edges a refinement scores Gaussians by; after a recovery-aware pruning
    /// all of them are used once. Default 10.
    pub edge_views: usize,
    /// Below this opacity a Gaussian is removed at a refinement. Default 0.005.
    pub prune_opacity: f64,
    /// Interval: steps between opacity resets. There is none after which fewer than `recovery`
    /// steps of growth are left, so that short runs have none. Default 3,000.
    pub reset_every: usize,
    /// Opacity that a reset leaves. Default 0.05.
    pub reset_opacity: f64,
    /// Interval: steps from a reset to the recovery-aware pruning after it. Default 300.
    pub recovery: usize,
    /// So many of the first resets are followed by a recovery-aware pruning. Default 2.
    pub recovery_prunes: usize,
    /// Share of the Gaussians, those of the lowest opacities, that it removes. Default 0.2.
    pub recovery_prune_share: f64,
    /// Whether the optimiser takes one step for the gradients of several, once growth has ended: 5
    /// from step 15,000 on and 20 from step 22,500 on, in a run of 30,000. Both shrink with the run
    /// as milestones do, down to 1, so that shorter runs have as many updates. Default true.
    pub multi_step_updates: bool,
    /// No growth beyond this many Gaussians. Default: none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_gaussians: Option<usize>,
    /// Natural selection of fewer Gaussians after growth. Default: none.
    pub selection: SelectionSettings,
}

impl Default for ImprovedGsSettings {
    fn default() -> Self {
        Self {
            start: 500,
            stop: 15_000,
            every: 100,
            early_prune: 300,
            early_prune_opacity: 0.02,
            grow_gradient: 3e-4,
            fill: 500,
            fill_gradient: 2e-4,
            edge_views: 10,
            prune_opacity: 0.005,
            reset_every: 3_000,
            reset_opacity: 0.05,
            recovery: 300,
            recovery_prunes: 2,
            recovery_prune_share: 0.2,
            multi_step_updates: true,
            max_gaussians: None,
            selection: SelectionSettings::default(),
        }
    }
}

impl ImprovedGsSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }

    /// How many survive the selection, if there is one.
    pub fn survivors(&self) -> Option<usize> {
        self.selection.survivors(self.max_gaussians)
    }

    /// The largest number of Gaussians during the run.
    pub(super) fn limit(&self) -> usize {
        let most = self.max_gaussians.unwrap_or(usize::MAX);
        let selected = self.selection.grown().unwrap_or(usize::MAX);
        most.min(selected)
    }

    /// Checks that the settings can be used.
    ///
    /// # Errors
    /// The field and why its value cannot be used, in one line.
    pub fn validate(&self) -> Result<(), String> {
        let counts = [
            ("every", self.every),
            ("reset_every", self.reset_every),
            ("edge_views", self.edge_views),
            ("max_gaussians", self.max_gaussians.unwrap_or(1)),
        ];
        if let Some((name, _)) = counts.iter().find(|(_, value)| *value == 0) {
            return Err(format!("`{name}` must be at least 1"));
        }
        // Infinity is a way to say never.
        let thresholds = [
            ("grow_gradient", self.grow_gradient),
            ("fill_gradient", self.fill_gradient),
        ];
        if let Some((name, value)) = thresholds.iter().find(|(_, value)| !(*value >= 0.0)) {
            return Err(format!("`{name}` must be at least 0, it is {value}"));
        }
        let shares = [
            ("early_prune_opacity", self.early_prune_opacity),
            ("prune_opacity", self.prune_opacity),
            ("reset_opacity", self.reset_opacity),
            ("recovery_prune_share", self.recovery_prune_share),
        ];
        if let Some((name, value)) = shares.iter().find(|(_, value)| !(0.0..1.0).contains(value)) {
            return Err(format!("`{name}` must lie in [0, 1), it is {value}"));
        }
        let (reset, prune) = (self.reset_opacity, self.prune_opacity);
        if reset <= prune {
            return Err(format!(
                "`reset_opacity` {reset} must be above `prune_opacity` {prune}, or every reset removes the scene"
            ));
        }
        let selection = &self.selection;
        let selects = selection.final_gaussians.is_some() || selection.final_share.is_some();
        if selects && selection.stop <= self.stop {
            return Err(format!(
                "`selection.stop` {} must come after `stop` {}, where growth ends and selection begins",
                selection.stop, self.stop
            ));
        }
        (self.selection.validate(self.max_gaussians))
            .map_err(|problem| problem.replacen('`', "`selection.", 1))
    }
}
