//! The numbers of Gaussians that growth is decided on.

use glam::{DQuat, DVec3};
use splat_ops::OpError;

use crate::opacity::sigmoid;
use crate::{Optimized, SplatModel};

/// Numbers of all Gaussians on the host, in double precision.
#[derive(Debug, Clone, Default)]
pub(super) struct Splats {
    pub(super) means: Vec<[f64; 3]>,
    pub(super) log_scales: Vec<[f64; 3]>,
    pub(super) quats: Vec<[f64; 4]>,
    pub(super) opacity_logits: Vec<f64>,
}

impl Splats {
    /// 11 numbers of each Gaussian.
    pub(super) fn read<M: SplatModel>(model: &Optimized<M>) -> Result<Self, OpError> {
        let [means, log_scales, quats, opacity_logits] =
            model.read_f64(["means", "log_scales", "quats", "opacity_logits"])?;
        Ok(Self {
            means: means.as_chunks().0.to_vec(),
            log_scales: log_scales.as_chunks().0.to_vec(),
            quats: quats.as_chunks().0.to_vec(),
            opacity_logits,
        })
    }

    pub(super) fn len(&self) -> usize {
        self.means.len()
    }

    pub(super) fn opacity(&self, row: usize) -> f64 {
        sigmoid(self.opacity_logits[row])
    }

    /// A place in units of standard deviations along the axes, as an offset from the mean: `R S x`.
    pub(super) fn offset(&self, row: usize, along_axes: [f64; 3]) -> [f64; 3] {
        let scales = DVec3::from_array(self.log_scales[row]).exp();
        let [w, x, y, z] = self.quats[row];
        let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
        let offset = rotation * (scales * DVec3::from_array(along_axes));
        // A quaternion without length has no axes to go along.
        if offset.is_finite() {
            offset.to_array()
        } else {
            [0.0; 3]
        }
    }
}
