//! Everything that determines a training run, apart from the capture and the loss.

use derive_setters::Setters;
use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use splat_model::ops::{AdamRows, ClampGradient, RasterizeSettings};
use splat_model::strategy::{AdcSettings, ImprovedGsSettings, McmcSettings};
use splat_model::{InitSettings, LearningRates, RenderSettings, SceneScale, ShReductionSettings};

use splat_data::Capture;
use splat_data::text::{one_line, utf8};

use crate::calibration::{CalibrationSchedule, CalibrationSettings};

/// Larger files are refused: parsing one could exhaust memory.
const LONGEST: usize = 1 << 20;
/// Beyond this, images shrink to nothing.
const MOST_HALVINGS: u32 = 8;
/// Views of a step, all of whose pictures are in memory at once.
const MOST_VIEWS: usize = 64;

/// More steps are no run: at a thousand a second they take thirty years. Quarters of it and the
/// like can be computed.
pub(super) const MOST_STEPS: u64 = 1_000_000_000_000;

/// Settings of a training run; together with the capture and the seed they repeat it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Setters)]
#[serde(default, deny_unknown_fields)]
#[setters(prefix = "with_", strip_option)]
pub struct TrainSettings {
    /// Number of steps; milestones stated for 30,000 steps shrink with shorter runs. Default
    /// 30,000.
    pub steps: usize,
    /// Seed of every random draw. Default 0.
    pub seed: u64,
    /// Photos are area-averaged by this factor when the program reads the capture; the library
    /// trains on the capture as it was loaded. Default 1.
    pub downscale: u32,
    /// Views that a step renders and takes the mean loss of. Default 1.
    pub views_per_step: usize,
    /// Training begins with photos whose sides are halved so many times, and doubles them step by
    /// step (3DGS section 7.1 has 2: a quarter, then a half). Default 0: photos are as they are
    /// from the beginning.
    pub coarse_halvings: u32,
    /// Steps between two doublings of the sides, in a run of 30,000. Default 250.
    pub coarse_every: usize,
    /// Training begins with small photos, which grow as their spectra ask for: the logarithm of the
    /// share of frequencies that they show rises in proportion to the steps (DashGaussian, section
    /// 4.1). Instead of `coarse_halvings`. Default false.
    pub spectral_resolution: bool,
    /// Milestone: photos are as they are from this step on, with `spectral_resolution`. Default
    /// 15,000.
    pub spectral_until: usize,
    /// One more degree of spherical harmonics every so many steps of a run of 30,000. Shorter runs
    /// have fewer, though not fewer than one pass over the photos takes. Default 1,000.
    pub sh_degree_every: usize,
    /// Multiply opacities by what the low-pass filter took away. Default false.
    pub antialias: bool,
    /// Colour behind the scene, linear RGB. When absent that of the capture, such as the white of
    /// Blender's; else black.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub background: Option<[f32; 3]>,
    /// Weight of 1 - SSIM against L1 in the default loss. Default 0.2.
    pub ssim_weight: f64,
    /// Adam steps only the Gaussians that the view saw, see [`AdamRows::Seen`]. Default false: on a
    /// capture where each view sees most of them it was no faster, and 0.06 dB worse (50 photos,
    /// 2,000 steps, mean of three seeds).
    pub seen_rows_only: bool,
    /// A step whose views see at most this share of the Gaussians leaves out the others, see
    /// [`SparseOptimized`](splat_model::SparseOptimized): with the result of a step of all, but for
    /// rounding. 0 means never. Default 0, until it has been measured.
    pub sparse_share: f64,
    /// Whether a run repeats bit for bit on a CubeCL device; false saves memory there, see
    /// [`RasterizeSettings::deterministic`]. On the CPU it always does. Default true.
    pub deterministic: bool,
    /// Which Gaussians there are, where the trainer is given no strategy of its own. Default
    /// `adc`.
    pub strategy: StrategyKind,
    /// Share of the default limit of growth, where the strategy's `max_gaussians` is absent;
    /// without effect where it is given. Infinity is no limit. Default 1.
    pub max_gaussians_share: f64,
    /// The first Gaussians.
    pub init: InitSettings,
    /// Learning rates; called `rates` in older files.
    #[serde(alias = "rates")]
    pub learning_rates: LearningRates,
    /// Adaptive density control, the strategy `adc`. Where `max_gaussians` is absent, growth ends
    /// at seven Gaussians for every ten pixels of a photo, or one for every hundred of all photos
    /// that are trained on (300 values for up to 59 parameters), whichever is more;
    /// docs/TRAINING.md has what more would give.
    pub density: AdcSettings,
    /// The strategy `mcmc`. Where `max_gaussians` is absent, growth ends as it does for `density`.
    pub mcmc: McmcSettings,
    /// The strategy `improved`. Where `max_gaussians` is absent, growth ends as it does for
    /// `density`.
    pub improved: ImprovedGsSettings,
    /// Fewer spherical harmonics for Gaussians whose colours hardly depend on the view, once in the
    /// run and on the evidence of all training views, see
    /// [`reduce_sh_degrees`](splat_model::reduce_sh_degrees); not before the highest degree is
    /// trained. From then on a Gaussian of degree 0 has 14 parameters instead of 59, and steps are
    /// of all Gaussians, whatever `sparse_share` says; with `seen_rows_only`, a coefficient is
    /// stepped if it has a gradient. Default none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sh_reduction: Option<ShReductionSettings>,
    /// Refinement of the cameras. Default none.
    pub calibration: CalibrationSettings,
}

/// A strategy of this crate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StrategyKind {
    /// [`Adc`](splat_model::strategy::Adc): adaptive density control; with `density.absgrad` that
    /// of AbsGS.
    #[default]
    Adc,
    /// [`Mcmc`](splat_model::strategy::Mcmc).
    Mcmc,
    /// [`ImprovedGs`](splat_model::strategy::ImprovedGs); with `improved.selection.final_gaussians`
    /// that of GNS.
    Improved,
}

impl TrainSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }
}

impl Default for TrainSettings {
    fn default() -> Self {
        Self {
            steps: 30_000,
            seed: 0,
            downscale: 1,
            views_per_step: 1,
            coarse_halvings: 0,
            coarse_every: 250,
            spectral_resolution: false,
            spectral_until: 15_000,
            sh_degree_every: 1_000,
            antialias: false,
            background: None,
            ssim_weight: 0.2,
            seen_rows_only: false,
            sparse_share: 0.0,
            deterministic: true,
            strategy: StrategyKind::default(),
            max_gaussians_share: 1.0,
            init: InitSettings::default(),
            learning_rates: LearningRates::default(),
            density: AdcSettings::default(),
            mcmc: McmcSettings::default(),
            improved: ImprovedGsSettings::default(),
            sh_reduction: None,
            calibration: CalibrationSettings::default(),
        }
    }
}

impl TrainSettings {
    /// Reads a `config.toml`, a byte-order mark before it or not; or says in a line what is wrong
    /// with it. Settings that it does not name have their defaults.
    ///
    /// # Errors
    /// When it is no text, no TOML, or names what is no setting.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        if bytes.len() > LONGEST {
            return Err(format!(
                "{} bytes; the settings of a run take a few hundred",
                bytes.len()
            ));
        }
        toml::from_str(utf8(bytes)?).map_err(|error| {
            let mut message = one_line(&error.to_string());
            if message.contains("unknown variant `absgrad`") {
                message += "; AbsGrad is `strategy = \"adc\"` with `absgrad = true` in `[density]`";
            }
            message
        })
    }

    /// The limit of growth of the strategy.
    pub fn max_gaussians(&self) -> Option<usize> {
        match self.strategy {
            StrategyKind::Adc => self.density.max_gaussians,
            StrategyKind::Mcmc => self.mcmc.max_gaussians,
            StrategyKind::Improved => self.improved.max_gaussians,
        }
    }

    /// Names of the sections that are not as by default and belong to a strategy that is not
    /// chosen, so that they have no effect.
    pub fn unused_sections(&self) -> Vec<&'static str> {
        let usual = Self::default();
        let changed = [
            (StrategyKind::Adc, "density", self.density != usual.density),
            (StrategyKind::Mcmc, "mcmc", self.mcmc != usual.mcmc),
            (
                StrategyKind::Improved,
                "improved",
                self.improved != usual.improved,
            ),
        ];
        (changed.into_iter())
            .filter(|(strategy, _, changed)| *changed && *strategy != self.strategy)
            .map(|(_, name, _)| name)
            .collect()
    }

    /// Limits the growth of the strategy.
    pub fn set_max_gaussians(&mut self, most: usize) {
        match self.strategy {
            StrategyKind::Adc => self.density.max_gaussians = Some(most),
            StrategyKind::Mcmc => self.mcmc.max_gaussians = Some(most),
            StrategyKind::Improved => self.improved.max_gaussians = Some(most),
        }
    }

    /// The settings that `other` has otherwise: name, value here, value there, as TOML has them.
    pub(super) fn differences(&self, other: &Self) -> Vec<(String, String, String)> {
        let mut found = Vec::new();
        match (toml::Table::try_from(self), toml::Table::try_from(other)) {
            (Ok(here), Ok(there)) => compare("", &here, &there, &mut found),
            // Such as a seed that is too large for TOML.
            _ if self != other => found.push(("settings".into(), "others".into(), "these".into())),
            _ => {}
        }
        found
    }

    /// The settings that `other` has otherwise, in words: `seed = 7, not 8`. Nothing if there is
    /// none.
    pub fn difference_in_words(&self, other: &Self) -> Option<String> {
        let differences = self.differences(other);
        let words = differences
            .iter()
            .map(|(name, here, there)| format!("{name} = {here}, not {there}"));
        let words = words.collect::<Vec<_>>().join("; ");
        (!words.is_empty()).then_some(words)
    }

    /// How to render a scene of this size, up to a degree of spherical harmonics.
    pub fn render_settings(&self, sh_degree: usize, scene: SceneScale) -> RenderSettings {
        RenderSettings {
            sh_degree,
            clamp_gradient: ClampGradient::Recovering,
            antialias: self.antialias,
            background: self.background,
            rasterize: RasterizeSettings {
                deterministic: self.deterministic,
                ..RasterizeSettings::default()
            },
            project: scene.project_settings(),
        }
    }

    /// When the cameras of a capture are refined.
    pub(crate) fn calibration_schedule(&self, capture: &Capture) -> CalibrationSchedule {
        let views = capture.split.train.len();
        (self.calibration).schedule(self.steps, views, self.views_per_step)
    }

    /// Which Gaussians the optimiser steps.
    pub fn adam_rows(&self) -> AdamRows {
        if self.seen_rows_only {
            AdamRows::Seen
        } else {
            AdamRows::All
        }
    }

    /// Checks that the settings can be used.
    ///
    /// # Errors
    /// The field and why its value cannot be used, in one line.
    pub fn validate(&self) -> Result<(), String> {
        self.check_counts()?;
        self.check_rates_and_shares()?;
        self.check_reachable_opacities()?;
        let (init, usual) = (&self.init, InitSettings::default());
        if self.strategy == StrategyKind::Mcmc
            && (init.opacity != usual.opacity || init.scale != usual.scale)
        {
            return Err(
                "`init.opacity` and `init.scale` have no effect with the strategy mcmc; set `mcmc.init_opacity` and `mcmc.init_scale`"
                    .to_owned(),
            );
        }
        if self.spectral_resolution && self.coarse_halvings > 0 {
            return Err(
                "`spectral_resolution` and `coarse_halvings` both say how photos grow; give one"
                    .to_owned(),
            );
        }
        if !(self.max_gaussians_share > 0.0) {
            let share = self.max_gaussians_share;
            return Err(format!(
                "`max_gaussians_share` must be above 0, it is {share}"
            ));
        }
        if self.strategy == StrategyKind::Improved
            && self.improved.selection.final_share.is_some()
            && self.improved.max_gaussians.is_none()
            && self.max_gaussians_share.is_infinite()
        {
            return Err(
                "`improved.selection.final_share` is a share of the limit of growth, and there is none: give `improved.max_gaussians` or a finite `max_gaussians_share`"
                    .to_owned(),
            );
        }
        let name = match self.strategy {
            StrategyKind::Mcmc => Some("mcmc"),
            StrategyKind::Improved if self.improved.selection.final_gaussians.is_none() => {
                Some("improved")
            }
            _ => None,
        };
        if let (Some(name), None, true) = (
            name,
            self.max_gaussians(),
            self.max_gaussians_share.is_infinite(),
        ) {
            return Err(format!(
                "nothing ends the growth of the strategy {name}: give `{name}.max_gaussians` (--max-gaussians) or a finite `max_gaussians_share`"
            ));
        }
        (self.mcmc.validate()).map_err(|problem| problem.replacen('`', "`mcmc.", 1))?;
        (self.improved.validate()).map_err(|problem| problem.replacen('`', "`improved.", 1))?;
        if let Some(reduction) = &self.sh_reduction {
            (reduction.validate()).map_err(|problem| problem.replacen('`', "`sh_reduction.", 1))?;
            if self.init.sh_degree == 0 {
                return Err(
                    "`sh_reduction` lowers degrees of spherical harmonics, and `init.sh_degree` is 0: leave it out"
                        .to_owned(),
                );
            }
        }
        (self.calibration.validate())
            .map_err(|problem| problem.replacen('`', "`calibration.", 1))?;
        if let Some(color) = self.background
            && !color.iter().all(|channel| channel.is_finite())
        {
            return Err(format!("`background` must be finite, it is {color:?}"));
        }
        let (degree, highest) = (self.init.sh_degree, splat_model::ops::SH_DEGREE_MAX);
        if degree > highest {
            return Err(format!(
                "`init.sh_degree` must be 0 to {highest}, it is {degree}"
            ));
        }
        Ok(())
    }

    fn check_counts(&self) -> Result<(), String> {
        let counts = [
            ("steps", self.steps),
            ("views_per_step", self.views_per_step),
            ("downscale", self.downscale as usize),
            ("coarse_every", self.coarse_every),
            ("sh_degree_every", self.sh_degree_every),
            ("density.every", self.density.every),
            ("density.reset_every", self.density.reset_every),
        ];
        if let Some((field, _)) = counts.iter().find(|(_, value)| *value == 0) {
            return Err(format!("`{field}` must be at least 1"));
        }
        let limits = [
            ("density.max_gaussians", self.density.max_gaussians),
            ("mcmc.max_gaussians", self.mcmc.max_gaussians),
        ];
        if let Some((field, _)) = limits.iter().find(|(_, most)| *most == Some(0)) {
            return Err(format!("`{field}` must be at least 1"));
        }
        if self.steps as u64 > MOST_STEPS {
            return Err(format!(
                "`steps` must be at most {MOST_STEPS}, it is {}",
                self.steps
            ));
        }
        if self.views_per_step > MOST_VIEWS {
            let views = self.views_per_step;
            return Err(format!(
                "`views_per_step` must be at most {MOST_VIEWS}, it is {views}"
            ));
        }
        if self.coarse_halvings > MOST_HALVINGS {
            return Err(format!(
                "`coarse_halvings` must be 0 to {MOST_HALVINGS}, it is {}",
                self.coarse_halvings
            ));
        }
        Ok(())
    }

    fn check_rates_and_shares(&self) -> Result<(), String> {
        let rates = &self.learning_rates;
        let finite_positive = [
            ("learning_rates.means", rates.means),
            ("learning_rates.means_final", rates.means_final),
            ("learning_rates.scales", rates.scales),
            ("learning_rates.quats", rates.quats),
            ("learning_rates.opacities", rates.opacities),
            ("learning_rates.sh0", rates.sh0),
            ("learning_rates.sh_rest", rates.sh_rest),
            ("init.scale", self.init.scale),
        ];
        let usable = |value: f64| value.is_finite() && value > 0.0;
        if let Some((field, value)) = finite_positive.iter().find(|(_, value)| !usable(*value)) {
            return Err(format!(
                "`{field}` must be positive and finite, it is {value}"
            ));
        }
        if !(0.0..=1.0).contains(&rates.short_run_exponent) {
            let exponent = rates.short_run_exponent;
            return Err(format!(
                "`learning_rates.short_run_exponent` must lie in [0, 1], it is {exponent}"
            ));
        }
        // Infinity is a way to say never.
        let not_negative = [
            ("density.grow_gradient", self.density.threshold()),
            ("density.split_scale", self.density.split_scale),
            ("density.prune_scale", self.density.prune_scale),
        ];
        if let Some((field, value)) = not_negative.iter().find(|(_, value)| !(*value >= 0.0)) {
            return Err(format!("`{field}` must be at least 0, it is {value}"));
        }
        let shares = [
            ("init.opacity", self.init.opacity),
            ("ssim_weight", self.ssim_weight),
            ("density.prune_opacity", self.density.prune_opacity),
            ("density.reset_opacity", self.density.reset_opacity),
        ];
        if !(0.0..=1.0).contains(&self.sparse_share) {
            let share = self.sparse_share;
            return Err(format!("`sparse_share` must lie in [0, 1], it is {share}"));
        }
        match shares.iter().find(|(_, value)| !(0.0..1.0).contains(value)) {
            Some((field, value)) => Err(format!("`{field}` must lie in [0, 1), it is {value}")),
            None => Ok(()),
        }
    }

    /// Refuses opacities that gradients could not bring back: below the cut nothing is drawn and
    /// nothing learns, and what a reset leaves below the opacity of pruning is removed.
    fn check_reachable_opacities(&self) -> Result<(), String> {
        let cut = RasterizeSettings::default().alpha_min;
        let starts = [
            ("init.opacity", self.init.opacity),
            ("density.reset_opacity", self.density.reset_opacity),
            ("mcmc.init_opacity", self.mcmc.init_opacity),
            ("improved.reset_opacity", self.improved.reset_opacity),
        ];
        if let Some((field, value)) = starts.iter().find(|(_, value)| *value <= cut) {
            return Err(format!(
                "`{field}` must be above 1/255, below which nothing is drawn or learned, it is {value}"
            ));
        }
        let (reset, prune) = (self.density.reset_opacity, self.density.prune_opacity);
        if reset <= prune {
            return Err(format!(
                "`density.reset_opacity` {reset} must be above `density.prune_opacity` {prune}, or every reset removes the scene"
            ));
        }
        Ok(())
    }
}

/// Collects what differs between two tables, of tables in them too.
fn compare(
    prefix: &str,
    here: &toml::Table,
    there: &toml::Table,
    found: &mut Vec<(String, String, String)>,
) {
    let keys: BTreeSet<&String> = here.keys().chain(there.keys()).collect();
    for key in keys {
        let name = format!("{prefix}{key}");
        match (here.get(key), there.get(key)) {
            (Some(toml::Value::Table(here)), Some(toml::Value::Table(there))) => {
                compare(&format!("{name}."), here, there, found);
            }
            (here, there) => {
                // As text, in which NaN equals itself.
                let [here, there] = [here, there]
                    .map(|value| value.map_or_else(|| "absent".to_owned(), toml::Value::to_string));
                if here != there {
                    found.push((name, here, there));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_are_read_with_and_without_a_byte_order_mark() {
        let mut config = TrainSettings {
            steps: 7,
            background: Some([0.0, 0.1, 1.0]),
            ..TrainSettings::default()
        };
        config.learning_rates.means = 0.1 + 0.2;
        config.sh_reduction = Some(ShReductionSettings::new().with_std(0.06));
        let text = toml::to_string(&config).unwrap();
        for text in [
            text.clone(),
            format!("\u{FEFF}{text}"),
            text.replace('\n', "\r\n"),
        ] {
            assert_eq!(TrainSettings::parse(text.as_bytes()).as_ref(), Ok(&config));
        }
        let utf16: Vec<u8> = "\u{FEFF}seed = 1"
            .encode_utf16()
            .flat_map(u16::to_le_bytes)
            .collect();
        for (bytes, words) in [
            (utf16.as_slice(), "UTF-16"),
            (b"seed = 1 # caf\xe9", "UTF-8"),
            (b"[package]\nname = \"other\"", "package"),
            (b"seed = -1", "seed"),
        ] {
            let message = TrainSettings::parse(bytes).unwrap_err();
            assert!(
                message.contains(words) && !message.contains('\n'),
                "{message}"
            );
        }
    }

    #[test]
    fn what_differs_is_named() {
        let here = TrainSettings::default();
        let mut there = here.clone();
        assert_eq!(here.difference_in_words(&there), None);
        there.seed = 3;
        there.learning_rates.sh0 *= 2.0;
        there.density.max_gaussians = Some(5);
        let words = here.difference_in_words(&there).unwrap();
        assert!(
            words.starts_with("density.max_gaussians = absent, not 5; learning_rates.sh0 = "),
            "{words}"
        );
        assert!(words.ends_with("; seed = 0, not 3"), "{words}");
        there.seed = u64::MAX;
        assert!(here.difference_in_words(&there).is_some());
    }

    #[test]
    fn settings_that_would_spoil_a_run_are_named() {
        let problem = |change: &dyn Fn(&mut TrainSettings)| {
            let mut config = TrainSettings::default();
            change(&mut config);
            config.validate().err().unwrap_or_default()
        };
        assert_eq!(problem(&|_| ()), "");
        for value in [f32::NAN, f32::INFINITY] {
            let found = problem(&|config| config.background = Some([0.0, value, 0.0]));
            assert!(found.contains("`background`"), "{found}");
        }
        let found = problem(&|config| config.steps = usize::MAX);
        assert!(found.contains("`steps` must be at most"), "{found}");
        let found = problem(&|config| config.density.grow_gradient = Some(f64::NAN));
        assert!(found.contains("`density.grow_gradient`"), "{found}");
        let found = problem(&|config| config.density.prune_scale = -1.0);
        assert!(found.contains("`density.prune_scale`"), "{found}");
        let found = problem(&|config| config.density.reset_opacity = 0.0);
        assert!(found.contains("`density.reset_opacity`"), "{found}");
        let found = problem(&|config| config.density.max_gaussians = Some(0));
        assert!(found.contains("`density.max_gaussians`"), "{found}");
        let found = problem(&|config| {
            config.strategy = StrategyKind::Mcmc;
            config.init.opacity = 0.3;
        });
        assert!(found.contains("`mcmc.init_opacity`"), "{found}");
        let message = TrainSettings::parse(b"strategy = \"absgrad\"").unwrap_err();
        assert!(message.contains("`[density]`"), "{message}");
        let found = problem(&|config| config.mcmc.init_opacity = 0.001);
        assert!(found.contains("`mcmc.init_opacity`"), "{found}");
        let found = problem(&|config| {
            (config.spectral_resolution, config.coarse_halvings) = (true, 1);
        });
        assert!(found.contains("`spectral_resolution`"), "{found}");
        let found = problem(&|config| config.max_gaussians_share = f64::NAN);
        assert!(found.contains("`max_gaussians_share`"), "{found}");
        let found = problem(&|config| {
            config.strategy = StrategyKind::Improved;
            config.max_gaussians_share = f64::INFINITY;
            config.improved.selection.final_share = Some(0.3);
        });
        assert!(
            found.contains("`improved.selection.final_share`"),
            "{found}"
        );
        for strategy in [StrategyKind::Mcmc, StrategyKind::Improved] {
            let found = problem(&|config| {
                config.strategy = strategy;
                config.max_gaussians_share = f64::INFINITY;
            });
            assert!(found.contains("nothing ends the growth"), "{found}");
            let mut ended = TrainSettings::new().with_strategy(strategy);
            ended.max_gaussians_share = f64::INFINITY;
            ended.set_max_gaussians(1_000);
            assert_eq!(ended.validate(), Ok(()));
        }
        let found = problem(&|config| {
            config.sh_reduction = Some(ShReductionSettings::new().with_at(1.0));
        });
        assert!(found.contains("`sh_reduction.at`"), "{found}");
        let found = problem(&|config| {
            config.sh_reduction = Some(ShReductionSettings::new());
            config.init.sh_degree = 0;
        });
        assert!(found.contains("`init.sh_degree` is 0"), "{found}");
        let found = problem(&|config| config.mcmc.growth = 0.5);
        assert!(found.contains("`mcmc.growth`"), "{found}");
        let found = problem(&|config| config.improved.reset_opacity = 0.003);
        assert!(found.contains("`improved.reset_opacity`"), "{found}");
        let found = problem(&|config| config.improved.selection.overgrowth = 0.5);
        assert!(found.contains("`improved.selection.overgrowth`"), "{found}");
        assert_eq!(
            problem(&|config| config.density.split_scale = f64::INFINITY),
            ""
        );
    }

    #[test]
    fn sections_of_other_strategies_are_named() {
        let mut config = TrainSettings::new();
        config.density.grow_gradient = Some(1e-3);
        assert_eq!(config.unused_sections(), [""; 0]);
        config.improved.selection.final_share = Some(0.3);
        assert_eq!(config.unused_sections(), ["improved"]);
        config.strategy = StrategyKind::Mcmc;
        assert_eq!(config.unused_sections(), ["density", "improved"]);
    }
}
