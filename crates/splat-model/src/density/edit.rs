//! Editing the rows of all fields of the Gaussians at once.

use burn::module::Param;
use burn::tensor::{Int, Tensor, TensorData};

use super::morton;
use crate::adam::{EditLog, RowEdit};
use crate::{Field, Gaussians};

/// The rows of the new model, in terms of the old.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RowPlan {
    /// Old row that each new row is made from.
    pub source: Vec<u32>,
    /// Whether the new row is the old Gaussian itself, so that its moments go on.
    pub survives: Vec<bool>,
    /// Added to the mean, world units.
    pub mean_offset: Vec<[f32; 3]>,
    /// Added to the log-scales.
    pub log_scale_offset: Vec<f32>,
}

impl RowPlan {
    /// A row that stays as it is.
    pub fn keep(&mut self, row: u32) {
        self.push(row, true, [0.0; 3], 0.0);
    }

    /// A new Gaussian made from an old one.
    pub fn add(&mut self, row: u32, mean_offset: [f32; 3], log_scale_offset: f32) {
        self.push(row, false, mean_offset, log_scale_offset);
    }

    fn push(&mut self, row: u32, survives: bool, mean_offset: [f32; 3], log_scale_offset: f32) {
        self.source.push(row);
        self.survives.push(survives);
        self.mean_offset.push(mean_offset);
        self.log_scale_offset.push(log_scale_offset);
    }

    /// Drops the new rows for which `keep` is false.
    pub fn retain(&mut self, keep: impl Fn(usize) -> bool) {
        let kept: Vec<usize> = (0..self.source.len()).filter(|i| keep(*i)).collect();
        self.select(&kept);
    }

    /// Orders the new rows so that neighbours in space are neighbours in memory, given the old means.
    pub fn arrange(&mut self, means: &[[f32; 3]]) {
        let rows = self.source.iter().zip(&self.mean_offset);
        let means: Vec<[f32; 3]> = rows
            .map(|(source, offset)| {
                let mean = means[*source as usize];
                [0, 1, 2].map(|axis| mean[axis] + offset[axis])
            })
            .collect();
        self.select(&morton::order(&means));
    }

    fn select(&mut self, rows: &[usize]) {
        *self = Self {
            source: rows.iter().map(|i| self.source[*i]).collect(),
            survives: rows.iter().map(|i| self.survives[*i]).collect(),
            mean_offset: rows.iter().map(|i| self.mean_offset[*i]).collect(),
            log_scale_offset: rows.iter().map(|i| self.log_scale_offset[*i]).collect(),
        };
    }
}

/// Rebuilds the model by a plan: a gather per field on the device. Parameters keep their ids, and
/// each field's log (in the order of [`Field::ALL`]) learns where its moments go.
pub fn apply_plan(gaussians: Gaussians, plan: &RowPlan, logs: &[EditLog; 6]) -> Gaussians {
    let n = plan.source.len();
    let device = gaussians.means.val().device().without_autodiff();
    let indices: Vec<i32> = plan.source.iter().map(|row| *row as i32).collect();
    let source = Tensor::<1, Int>::from_data(TensorData::new(indices, [n]), &device);
    let keep: Vec<f32> = plan.survives.iter().map(|s| f32::from(*s)).collect();
    let keep = Tensor::<1>::from_data(TensorData::new(keep, [n]), &device);
    for log in logs {
        log.push(RowEdit::Gather {
            source: source.clone(),
            keep: keep.clone(),
        });
    }
    let mean_offset = Tensor::<2>::from_data(
        TensorData::new(plan.mean_offset.as_flattened().to_vec(), [n, 3]),
        &device,
    );
    let log_scale_offset = Tensor::<2>::from_data(
        TensorData::new(plan.log_scale_offset.clone(), [n, 1]),
        &device,
    );
    let gather2 = |x: Tensor<2>| x.select(0, source.clone());
    let gather3 = |x: Tensor<3>| x.select(0, source.clone());
    Gaussians {
        origin: gaussians.origin,
        means: edit(gaussians.means, |x| gather2(x) + mean_offset),
        log_scales: edit(gaussians.log_scales, |x| gather2(x) + log_scale_offset),
        quats: edit(gaussians.quats, gather2),
        opacity_logits: edit(gaussians.opacity_logits, |x| x.select(0, source.clone())),
        sh0: edit(gaussians.sh0, gather3),
        sh_rest: gaussians.sh_rest.map(|param| edit(param, gather3)),
    }
}

/// Lowers every opacity to at most `opacity` and restarts the moments of the logits (the opacity
/// reset of 3DGS section 5.2).
pub fn clamp_opacities(mut gaussians: Gaussians, opacity: f64, logs: &[EditLog; 6]) -> Gaussians {
    let logit = (opacity / (1.0 - opacity)).ln();
    gaussians.opacity_logits = edit(gaussians.opacity_logits, |x| x.clamp_max(logit));
    for (field, log) in Field::ALL.iter().zip(logs) {
        if *field == Field::OpacityLogits {
            log.push(RowEdit::Restart);
        }
    }
    gaussians
}

/// Replaces a parameter's value outside of the autodiff graph, under the same id.
fn edit<const D: usize>(
    param: Param<Tensor<D>>,
    change: impl FnOnce(Tensor<D>) -> Tensor<D>,
) -> Param<Tensor<D>> {
    param.map(|value| {
        let tracked = value.device().is_autodiff();
        let changed = change(value.inner());
        if tracked {
            Tensor::from_inner(changed).require_grad()
        } else {
            changed
        }
    })
}
