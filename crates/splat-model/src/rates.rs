//! One learning rate and one optimiser per field of the Gaussians (3DGS section 7.1; values of
//! gsplat's default column).

use burn::module::ParamGroup;
use burn::optim::ModuleOptimizer;
use burn::optim::lr_scheduler::module_lr_scheduler::{ModuleLearningRate, ModuleLrScheduler};
use serde::{Deserialize, Serialize};
use splat_ops::AdamRows;

use crate::adam::{EditLog, SplatAdam};
use splat_data::SceneScale;

/// The fields of [`Gaussians`](crate::Gaussians), by the names they have there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Field {
    /// Centres.
    Means,
    /// Log-scales.
    LogScales,
    /// Rotations.
    Quats,
    /// Opacity logits.
    OpacityLogits,
    /// Spherical harmonics of degree 0.
    Sh0,
    /// Spherical harmonics of the higher degrees.
    ShRest,
}

impl Field {
    /// All of them.
    pub const ALL: [Self; 6] = [
        Self::Means,
        Self::LogScales,
        Self::Quats,
        Self::OpacityLogits,
        Self::Sh0,
        Self::ShRest,
    ];

    fn group(self) -> ParamGroup {
        ParamGroup::from_path(match self {
            Self::Means => "means",
            Self::LogScales => "log_scales",
            Self::Quats => "quats",
            Self::OpacityLogits => "opacity_logits",
            Self::Sh0 => "sh0",
            Self::ShRest => "sh_rest",
        })
    }
}

/// Learning rates per field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LearningRates {
    /// Of the means at the first step, in units of the scene's scale.
    pub means: f64,
    /// The means' rate decays exponentially to this share of itself at the last step.
    pub means_final: f64,
    /// Of the log-scales.
    pub scales: f64,
    /// Of the quaternions.
    pub quats: f64,
    /// Of the opacity logits.
    pub opacities: f64,
    /// Of the spherical harmonics of degree 0.
    pub sh0: f64,
    /// Of the higher spherical harmonics.
    pub sh_rest: f64,
}

impl Default for LearningRates {
    fn default() -> Self {
        Self {
            means: 1.6e-4,
            means_final: 0.01,
            scales: 5e-3,
            quats: 1e-3,
            opacities: 5e-2,
            sh0: 2.5e-3,
            sh_rest: 1.25e-4,
        }
    }
}

impl LearningRates {
    /// The rates by name, and how many times its default each is.
    pub fn factors(&self) -> [(&'static str, f64); 6] {
        let default = Self::default();
        [
            ("means", self.means / default.means),
            ("scales", self.scales / default.scales),
            ("quats", self.quats / default.quats),
            ("opacities", self.opacities / default.opacities),
            ("sh0", self.sh0 / default.sh0),
            ("sh_rest", self.sh_rest / default.sh_rest),
        ]
    }

    /// The rates at a step (from 0) of a run of `steps`, for Burn's module optimiser.
    pub fn at(&self, step: usize, steps: usize, scene: SceneScale) -> ModuleLearningRate {
        let progress = step as f64 / steps.max(1) as f64;
        let rate = |field| match field {
            Field::Means => self.means * scene.length() * self.means_final.powf(progress),
            Field::LogScales => self.scales,
            Field::Quats => self.quats,
            Field::OpacityLogits => self.opacities,
            Field::Sh0 => self.sh0,
            Field::ShRest => self.sh_rest,
        };
        // Burn lets only a scheduler build rates per group; constants make it one for this step.
        Field::ALL
            .into_iter()
            .fold(ModuleLrScheduler::new(0.0), |rates, field| {
                rates.with_group(field.group(), rate(field))
            })
            .step()
    }
}

/// A module optimiser with one [`SplatAdam`] per field, stepping `rows`, and the logs through which density control
/// tells them of edited rows, in the order of [`Field::ALL`].
pub fn splat_optimizer(rows: AdamRows, scene: SceneScale) -> (ModuleOptimizer, [EditLog; 6]) {
    let logs: [EditLog; 6] = Default::default();
    let fallback = ModuleOptimizer::from(SplatAdam::new(EditLog::default()));
    let optimizer = Field::ALL
        .into_iter()
        .zip(&logs)
        .fold(fallback, |optimizer, (field, log)| {
            let mut adam = SplatAdam::new(log.clone());
            adam.rows = rows;
            if field == Field::Means {
                adam.epsilon = scene.means_epsilon();
            }
            optimizer.with_group(field.group(), adam, None)
        });
    (optimizer, logs)
}
