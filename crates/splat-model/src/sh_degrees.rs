//! Gaussians of different degrees of spherical harmonics (reduced-3dgs, Papantonakis et al. 2024).

#[cfg(all(test, feature = "cpu"))]
mod tests;

use burn::tensor::{Int, Tensor, TensorData};
use splat_ops::{OpError, SH_DEGREE_MAX, ShStarts, sh_coefficient_count};

use crate::gaussians::host;
use crate::optimized::outside_graph;
use crate::{Gaussians, OwnedRows, SH_COEFFICIENTS};

impl Gaussians {
    /// Degree of the spherical harmonics of each Gaussian.
    pub fn sh_degrees(&self) -> Vec<usize> {
        match &self.sh_starts {
            Some(starts) => starts.degrees().collect(),
            None => vec![self.sh_degree(); self.len()],
        }
    }

    /// Gives each Gaussian at most the given degree, 0 to 3, by dropping coefficients beyond it. A
    /// Gaussian of degree 0 then has 14 parameters, one of degree 3 has 59.
    ///
    /// From then on the coefficients are rows of their own, `[K, 1, 3]`, as many as all degrees
    /// take, in the row set [`SH_COEFFICIENTS`]. They follow their Gaussians through edits of rows.
    /// Such a model cannot leave out Gaussians in a step, see
    /// [`SparseOptimized`](crate::SparseOptimized). To be called before the model has optimisers;
    /// [`reduce_sh_degrees`](crate::reduce_sh_degrees) lowers degrees in training.
    ///
    /// ```
    /// use burn::tensor::Device;
    /// use splat_model::{Gaussians, SplatData};
    ///
    /// let splats = SplatData {
    ///     means: vec![[0.0; 3]; 2],
    ///     log_scales: vec![[0.0; 3]; 2],
    ///     quats: vec![[1.0, 0.0, 0.0, 0.0]; 2],
    ///     opacity_logits: vec![0.0; 2],
    ///     sh0: vec![[0.0; 3]; 2],
    ///     sh_rest: vec![0.5; 2 * 45],
    ///     sh_degree: 3,
    ///     ..SplatData::default()
    /// };
    /// let gaussians = Gaussians::from_data(&splats, &Device::flex()).with_sh_degrees(&[1, 0])?;
    /// assert_eq!(gaussians.sh_rest.as_ref().unwrap().val().dims(), [3, 1, 3]);
    /// let splats = gaussians.to_data();
    /// assert_eq!((splats.sh_degree, splats.degree_of(0), splats.degree_of(1)), (1, 1, 0));
    /// # Ok::<(), splat_model::ops::OpError>(())
    /// ```
    ///
    /// # Errors
    /// When the number of degrees is not that of the Gaussians, a degree is above 3, or the model
    /// has no coefficients beyond degree 0.
    pub fn with_sh_degrees(mut self, degrees: &[usize]) -> Result<Self, OpError> {
        if let Some(degree) = degrees.iter().find(|degree| **degree > SH_DEGREE_MAX) {
            return Err(wrong(format!(
                "degree {degree} is not available; the highest is {SH_DEGREE_MAX}"
            )));
        }
        self.keep_owned_rows(&rows_of_degrees(degrees))?;
        Ok(self)
    }

    /// Number of coefficients of each Gaussian beyond degree 0.
    fn coefficients(&self) -> Vec<u32> {
        let of_degree = |degree: usize| sh_coefficient_count(degree) as u32 - 1;
        self.sh_degrees().into_iter().map(of_degree).collect()
    }

    pub(crate) fn keep_owned_rows(&mut self, most: &OwnedRows) -> Result<(), OpError> {
        let Some(rest) = self.sh_rest.take_if(|_| most.row_set() == SH_COEFFICIENTS) else {
            return Err(wrong(match most.row_set() {
                SH_COEFFICIENTS => "the Gaussians have no coefficients beyond degree 0".to_owned(),
                set => format!("the Gaussians have no rows of a set {set}"),
            }));
        };
        let own = self.coefficients_of(&rest.val());
        let starts = match most.gaussians() == self.len() {
            true => {
                let kept = own
                    .counts()
                    .zip(most.counts())
                    .map(|(own, most)| own.min(most));
                starts_of(&OwnedRows::of_counts(SH_COEFFICIENTS, kept), &rest.val())
            }
            false => Err(wrong(format!(
                "degrees of {} Gaussians for a model of {}",
                most.gaussians(),
                self.len()
            ))),
        };
        let starts = match starts {
            Ok(starts) => starts,
            Err(error) => {
                self.sh_rest = Some(rest);
                return Err(error);
            }
        };
        let firsts = own.starts().iter().zip(starts.starts().windows(2));
        let indices: Vec<i32> = firsts
            .flat_map(|(first, pair)| (*first..first + pair[1] - pair[0]).map(|row| row as i32))
            .collect();
        let kept = |value: Tensor<3>| {
            let (device, dtype) = (value.device(), value.dtype());
            if indices.is_empty() {
                return Tensor::zeros([0, 1, 3], (&device, dtype));
            }
            let rows = own.rows();
            let count = indices.len();
            let indices = Tensor::<1, Int>::from_data(TensorData::new(indices, [count]), &device);
            value.reshape([rows, 1, 3]).select(0, indices)
        };
        self.sh_rest = Some(rest.map(|value| outside_graph(value, kept)));
        self.sh_starts = Some(starts);
        Ok(())
    }

    pub(crate) fn set_owned_rows(&mut self, rows: &OwnedRows) -> Result<(), OpError> {
        let rest = self.sh_rest.as_ref().map(|rest| rest.val());
        let Some(rest) = rest.filter(|_| rows.row_set() == SH_COEFFICIENTS) else {
            return Err(wrong(format!(
                "the Gaussians have no rows of a set {}",
                rows.row_set()
            )));
        };
        let found = rest.dims();
        if found != [rows.rows(), 1, 3] || rows.gaussians() != self.len() {
            return Err(wrong(format!(
                "`sh_rest` of {} Gaussians has shape {found:?}; {} rows belong to {} Gaussians",
                self.len(),
                rows.rows(),
                rows.gaussians()
            )));
        }
        self.sh_starts = Some(starts_of(rows, &rest)?);
        Ok(())
    }

    /// Rows of the coefficients as they are, counted by three channels.
    fn coefficients_of(&self, rest: &Tensor<3>) -> OwnedRows {
        match &self.sh_starts {
            Some(_) => OwnedRows::of_counts(SH_COEFFICIENTS, self.coefficients()),
            None => {
                let [n, stored, _] = rest.dims();
                OwnedRows::of_counts(SH_COEFFICIENTS, vec![stored as u32; n])
            }
        }
    }

    /// Coefficients beyond degree 0, all at the highest degree, `[N, (degree + 1)^2 - 1, 3]`, with
    /// zeros beyond a Gaussian's own.
    pub(crate) fn padded_sh_rest(&self) -> Vec<f32> {
        let Some(rest) = &self.sh_rest else {
            return Vec::new();
        };
        let values = host(rest.val());
        let Some(starts) = &self.sh_starts else {
            return values;
        };
        let width = 3 * (sh_coefficient_count(starts.highest_degree()) - 1);
        let mut padded = vec![0.0; width * starts.len()];
        if width > 0 {
            let pairs = starts.starts().windows(2);
            for (row, pair) in padded.chunks_exact_mut(width).zip(pairs) {
                // Someone may have set starts that do not belong to these coefficients.
                let own = values.get(3 * pair[0] as usize..3 * pair[1] as usize);
                for (value, own) in row.iter_mut().zip(own.unwrap_or_default()) {
                    *value = *own;
                }
            }
        }
        padded
    }
}

/// Rows of Gaussians of these degrees.
pub(crate) fn rows_of_degrees(degrees: &[usize]) -> OwnedRows {
    let counts = degrees
        .iter()
        .map(|degree| sh_coefficient_count(*degree) as u32 - 1);
    OwnedRows::of_counts(SH_COEFFICIENTS, counts)
}

fn starts_of(rows: &OwnedRows, rest: &Tensor<3>) -> Result<ShStarts, OpError> {
    ShStarts::new(rows.starts().to_vec(), &rest.device())
}

fn wrong(what: String) -> OpError {
    OpError::Argument {
        op: "Gaussians::with_sh_degrees",
        what,
    }
}
