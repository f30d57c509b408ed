//! Everything that determines a training run, apart from the capture and the loss.

use serde::{Deserialize, Serialize};
use splat_model::density::AdaptiveSettings;
use splat_model::ops::{AdamRows, RasterizeSettings};
use splat_model::{InitSettings, LearningRates, RenderSettings};

/// More would leave no photo anything to see.
const MOST_HALVINGS: u32 = 8;

/// More steps are no run: at a thousand a second they take thirty years. Quarters of it and the like can be computed.
pub(super) const MOST_STEPS: u64 = 1_000_000_000_000;

/// Settings of a training run; together with the capture and the seed they repeat it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainConfig {
    /// Number of steps; milestones stated for 30,000 steps shrink with shorter runs. Default 30,000.
    pub steps: usize,
    /// Seed of every random draw. Default 0.
    pub seed: u64,
    /// Photos are area-averaged by this factor. Default 1.
    pub downscale: u32,
    /// Training begins with photos whose sides are halved so many times, and doubles them step by step (3DGS section 7.1
    /// has 2: a quarter, then a half). Default 0: photos are as they are from the beginning.
    pub coarse_halvings: u32,
    /// So many steps of a run of 30,000 until the sides are doubled. Default 250.
    pub coarse_every: usize,
    /// One more degree of spherical harmonics every so many steps of a run of 30,000. Default 1,000.
    pub sh_degree_every: usize,
    /// Multiply opacities by what the low-pass filter took away. Default false.
    pub antialias: bool,
    /// Colour behind the scene, linear RGB; black when absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub background: Option<[f32; 3]>,
    /// Weight of 1 - SSIM against L1 in the default loss. Default 0.2.
    pub ssim_weight: f64,
    /// Adam steps only the Gaussians that the view saw, see [`AdamRows::Seen`]. Default false: on a capture where each
    /// view sees most of them it was no faster, and 0.06 dB worse (50 photos, 2,000 steps, mean of three seeds).
    pub seen_rows_only: bool,
    /// Whether a run repeats bit for bit on a CubeCL device; false saves memory there, see
    /// [`RasterizeSettings::deterministic`]. On the CPU it always does. Default true.
    pub deterministic: bool,
    /// The first Gaussians.
    pub init: InitSettings,
    /// Learning rates.
    pub rates: LearningRates,
    /// Adaptive density control. Where `max_gaussians` is absent, growth ends at seven Gaussians for every ten pixels of a
    /// photo, or one for every hundred of all photos that are trained on (300 values for up to 59 parameters), whichever is
    /// more; docs/TRAINING.md has what more would give.
    pub density: AdaptiveSettings,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            steps: 30_000,
            seed: 0,
            downscale: 1,
            coarse_halvings: 0,
            coarse_every: 250,
            sh_degree_every: 1_000,
            antialias: false,
            background: None,
            ssim_weight: 0.2,
            seen_rows_only: false,
            deterministic: true,
            init: InitSettings::default(),
            rates: LearningRates::default(),
            density: AdaptiveSettings::default(),
        }
    }
}

impl TrainConfig {
    /// How to render at a degree of spherical harmonics.
    pub fn render_settings(&self, sh_degree: usize) -> RenderSettings {
        RenderSettings {
            sh_degree,
            antialias: self.antialias,
            background: self.background,
            rasterize: RasterizeSettings {
                deterministic: self.deterministic,
                ..RasterizeSettings::default()
            },
            ..RenderSettings::default()
        }
    }

    /// Which Gaussians the optimiser steps.
    pub fn adam_rows(&self) -> AdamRows {
        if self.seen_rows_only {
            AdamRows::Seen
        } else {
            AdamRows::All
        }
    }

    /// What makes the settings unusable, if anything does: the field and the reason.
    pub fn problem(&self) -> Option<String> {
        let finite_positive = [
            ("rates.means", self.rates.means),
            ("rates.means_final", self.rates.means_final),
            ("rates.scales", self.rates.scales),
            ("rates.quats", self.rates.quats),
            ("rates.opacities", self.rates.opacities),
            ("rates.sh0", self.rates.sh0),
            ("rates.sh_rest", self.rates.sh_rest),
            ("init.scale", self.init.scale),
        ];
        let shares = [
            ("init.opacity", self.init.opacity),
            ("ssim_weight", self.ssim_weight),
            ("density.prune_opacity", self.density.prune_opacity),
            ("density.reset_opacity", self.density.reset_opacity),
        ];
        let counts = [
            ("steps", self.steps),
            ("coarse_every", self.coarse_every),
            ("sh_degree_every", self.sh_degree_every),
            ("density.every", self.density.every),
            ("density.reset_every", self.density.reset_every),
        ];
        if let Some((field, _)) = counts.iter().find(|(_, value)| *value == 0) {
            return Some(format!("`{field}` must be at least 1"));
        }
        if self.steps as u64 > MOST_STEPS {
            return Some(format!(
                "`steps` must be at most {MOST_STEPS}, it is {}",
                self.steps
            ));
        }
        if self.downscale == 0 {
            return Some("`downscale` must be at least 1".into());
        }
        if self.coarse_halvings > MOST_HALVINGS {
            return Some(format!(
                "`coarse_halvings` must be 0 to {MOST_HALVINGS}, it is {}",
                self.coarse_halvings
            ));
        }
        if let Some((field, value)) = finite_positive
            .iter()
            .find(|(_, value)| !(value.is_finite() && *value > 0.0))
        {
            return Some(format!(
                "`{field}` must be positive and finite, it is {value}"
            ));
        }
        if let Some((field, value)) = shares.iter().find(|(_, value)| !(0.0..1.0).contains(value)) {
            return Some(format!("`{field}` must lie in [0, 1), it is {value}"));
        }
        if self.density.reset_opacity == 0.0 {
            return Some(
                "`density.reset_opacity` must be above 0; nothing would come back from it".into(),
            );
        }
        let sizes = [
            ("density.grow_gradient", self.density.grow_gradient),
            ("density.split_scale", self.density.split_scale),
            ("density.prune_scale", self.density.prune_scale),
        ];
        // Infinity is a way to say never.
        if let Some((field, value)) = sizes.iter().find(|(_, value)| !(*value >= 0.0)) {
            return Some(format!("`{field}` must be at least 0, it is {value}"));
        }
        if let Some(background) = self.background.filter(|b| !b.iter().all(|x| x.is_finite())) {
            return Some(format!("`background` must be finite, it is {background:?}"));
        }
        let highest = splat_model::ops::SH_DEGREE_MAX;
        (self.init.sh_degree > highest).then(|| {
            format!(
                "`init.sh_degree` must be 0 to {highest}, it is {}",
                self.init.sh_degree
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_that_would_spoil_a_run_are_named() {
        let problem = |change: &dyn Fn(&mut TrainConfig)| {
            let mut config = TrainConfig::default();
            change(&mut config);
            config.problem().unwrap_or_default()
        };
        assert_eq!(problem(&|_| ()), "");
        for value in [f32::NAN, f32::INFINITY] {
            let found = problem(&|config| config.background = Some([0.0, value, 0.0]));
            assert!(found.contains("`background`"), "{found}");
        }
        let found = problem(&|config| config.steps = usize::MAX);
        assert!(found.contains("`steps` must be at most"), "{found}");
        let found = problem(&|config| config.density.grow_gradient = f64::NAN);
        assert!(found.contains("`density.grow_gradient`"), "{found}");
        let found = problem(&|config| config.density.prune_scale = -1.0);
        assert!(found.contains("`density.prune_scale`"), "{found}");
        let found = problem(&|config| config.density.reset_opacity = 0.0);
        assert!(found.contains("`density.reset_opacity`"), "{found}");
        assert_eq!(
            problem(&|config| config.density.split_scale = f64::INFINITY),
            ""
        );
    }
}
