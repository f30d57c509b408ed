//! Compares a scene in single precision on a device with double precision on the CPU.

use burn::tensor::Device;
use splat_ops::OpError;

use crate::gradcheck::{
    Array, Computed, Fixture, GradcheckError, Inputs, NEAR, Precision, Scene, compare, run, walk,
};

/// Why a case cannot be measured.
#[derive(Debug, thiserror::Error)]
pub enum AccuracyError {
    /// A scene could not be run.
    #[error(transparent)]
    Run(#[from] GradcheckError),
    /// An op refused its input.
    #[error(transparent)]
    Op(#[from] OpError),
    /// Results could not be read back.
    #[error("results cannot be read back: {0}")]
    Read(String),
}

/// Result of a case on one device.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Outcome {
    /// Relative L2 error of the image (or of its substitute).
    pub forward: f64,
    /// Relative L2 error of the worst parameter group.
    pub gradient: f64,
    /// Name of that group.
    pub worst_group: String,
    /// Pixels within 1e-6 of a threshold, which rounding may flip.
    pub near_threshold: usize,
    /// (Pixel, splat) pairs blended.
    pub blended: u64,
    /// Additional findings.
    pub detail: String,
    /// True if the case's demand holds.
    pub holds: bool,
}

impl Outcome {
    /// No measurements and no failures.
    pub(super) fn new() -> Self {
        Self {
            holds: true,
            ..Self::default()
        }
    }

    /// The worse of both, for a case of several scenes.
    pub(super) fn and(mut self, other: Self) -> Self {
        if !(other.gradient <= self.gradient) {
            self.gradient = other.gradient;
            self.worst_group = other.worst_group;
        }
        if !(other.forward <= self.forward) {
            self.forward = other.forward;
        }
        self.near_threshold += other.near_threshold;
        self.blended += other.blended;
        self.holds &= other.holds;
        if !other.detail.is_empty() {
            if !self.detail.is_empty() {
                self.detail += "; ";
            }
            self.detail += &other.detail;
        }
        self
    }

    /// Adds a demand; `what` describes it if it does not hold.
    pub(super) fn demand(mut self, holds: bool, what: impl Into<String>) -> Self {
        if !holds {
            self.holds = false;
            self.detail = format!("{} NOT: {}", self.detail, what.into())
                .trim()
                .to_owned();
        }
        self
    }

    /// Adds a remark.
    pub(super) fn note(mut self, what: impl Into<String>) -> Self {
        if !self.detail.is_empty() {
            self.detail += "; ";
        }
        self.detail += &what.into();
        self
    }
}

/// The scene in single precision on `device`.
pub(super) fn single(scene: &Scene, device: &Device) -> Result<Computed, AccuracyError> {
    Ok(run(scene, device, Precision::F32, None)?)
}

/// The scene in double precision on the CPU.
pub(super) fn double(scene: &Scene) -> Result<Computed, AccuracyError> {
    Ok(run(scene, &Device::flex(), Precision::F64, None)?)
}

/// Compares image, alpha and every gradient of `scene` in single precision on `device` with double
/// precision. Groups named in `zero` have a gradient of zero by symmetry, hidden by rounding.
pub(super) fn against_double(
    scene: &Scene,
    device: &Device,
    zero: &[&str],
) -> Result<Outcome, AccuracyError> {
    Ok(judge(scene, &single(scene, device)?, double(scene)?, zero))
}

/// Judges `ours` by `reference`, both of `scene`, with the gates of hard cases.
pub(super) fn judge(
    scene: &Scene,
    ours: &Computed,
    mut reference: Computed,
    zero: &[&str],
) -> Outcome {
    for name in zero {
        if let Some(array) = group(&mut reference.gradients, name) {
            *array = Array::zeros(&array.shape);
        }
    }
    let walked = walk(scene, &reference, NEAR);
    let fixture = Fixture {
        case: String::new(),
        hard: true,
        scene: scene.clone(),
        expected: reference.outputs,
        gradients: reference.gradients,
        absgrad: reference.absgrad,
    };
    let report = compare(&fixture, ours, Precision::F32, walked.near_threshold);
    let (worst_group, gradient) = report.worst_group();
    let forward = report.outputs.iter().map(|output| output.rel_l2);
    let outcome = Outcome {
        forward: forward.max_by(f64::total_cmp).unwrap_or(0.0),
        gradient,
        worst_group: worst_group.to_owned(),
        near_threshold: walked.near_threshold,
        blended: walked.blended,
        ..Outcome::new()
    };
    outcome.demand(
        report.pass,
        format!(
            "{}: {} beyond {:.0e}",
            scene.source.display(),
            report.failed().join(", "),
            report.gate
        ),
    )
}

fn group<'a>(inputs: &'a mut Inputs, name: &str) -> Option<&'a mut Array> {
    Some(match name {
        "means" => &mut inputs.means,
        "quats" => &mut inputs.quats,
        "scales" => &mut inputs.scales,
        "opacities" => &mut inputs.opacities,
        "sh_coeffs" => &mut inputs.sh_coeffs,
        "viewmat" => &mut inputs.viewmat,
        "intrinsics" => &mut inputs.intrinsics,
        "background" => &mut inputs.background,
        "distortion" => inputs.distortion.as_mut()?,
        _ => return None,
    })
}

/// All gradients of a scene, concatenated.
pub(super) fn gradients(computed: &Computed) -> Vec<f64> {
    let g = &computed.gradients;
    [
        &g.means,
        &g.quats,
        &g.scales,
        &g.opacities,
        &g.sh_coeffs,
        &g.viewmat,
        &g.intrinsics,
        &g.background,
    ]
    .into_iter()
    .chain(&g.distortion)
    .flat_map(|array| array.values.iter().copied())
    .collect()
}

/// The first scene of `make`, by seed, in which every pixel keeps a relative distance of `margin`
/// from every threshold in double precision, so that only rounding error is measured. The last one
/// tried if there is none.
pub(super) fn clear(margin: f64, make: impl Fn(u64) -> Scene) -> Scene {
    clear_but(0, margin, make)
}

/// [`clear`], allowing `near` pixels near a threshold that the case puts there on purpose.
pub(super) fn clear_but(near: usize, margin: f64, make: impl Fn(u64) -> Scene) -> Scene {
    const SEEDS: u64 = 200;
    let is_clear = |scene: &Scene| {
        double(scene).is_ok_and(|computed| walk(scene, &computed, margin).near_threshold <= near)
    };
    (0..SEEDS)
        .map(&make)
        .find(is_clear)
        .unwrap_or_else(|| make(SEEDS))
}
