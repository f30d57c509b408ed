//! Where the coefficients of each Gaussian lie, where Gaussians have different degrees.

use core::fmt;
use std::sync::Arc;

use burn::tensor::{DType, Device, Int, Tensor, TensorData};
use splat_core::{SH_DEGREE_MAX, sh_coefficient_count, sh_degree_of};

use crate::OpError;

/// Rows of the coefficients of each of N Gaussians, each of which has as many as its own degree
/// takes beyond degree 0: none, 3, 8 or 15. Those of Gaussian i are the rows `starts[i]..starts[i +
/// 1]`.
///
/// The starts are checked here, once, on the host, so that no kernel has to: whatever holds a
/// `ShStarts` may read the rows that it names.
///
/// ```
/// use burn::tensor::Device;
/// use splat_ops::ShStarts;
///
/// let starts = ShStarts::of_degrees([1, 0, 2], &Device::flex())?;
/// assert_eq!(starts.starts(), [0, 3, 3, 11]);
/// assert_eq!((starts.len(), starts.rows(), starts.highest_degree()), (3, 11, 2));
/// assert!(ShStarts::new(vec![0, 4], &Device::flex()).is_err()); // no degree has 4
/// # Ok::<(), splat_ops::OpError>(())
/// ```
#[derive(Clone)]
pub struct ShStarts {
    /// `[N + 1]`.
    starts: Arc<[u32]>,
    highest: usize,
    /// The same on the device, outside the autodiff graph.
    tensor: Tensor<1, Int>,
}

impl fmt::Debug for ShStarts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ShStarts")
            .field("gaussians", &self.len())
            .field("rows", &self.rows())
            .finish_non_exhaustive()
    }
}

impl ShStarts {
    /// The starts of Gaussians of these degrees, 0 to 3 each, in order and without gaps.
    ///
    /// # Errors
    /// When a degree is above 3, or there are more than 2^31 - 1 rows.
    pub fn of_degrees(
        degrees: impl IntoIterator<Item = usize>,
        device: &Device,
    ) -> Result<Self, OpError> {
        let mut starts = vec![0];
        let mut rows = 0u32;
        for (index, degree) in degrees.into_iter().enumerate() {
            if degree > SH_DEGREE_MAX {
                return Err(wrong(format!(
                    "Gaussian {index} is of degree {degree}; the highest is {SH_DEGREE_MAX}"
                )));
            }
            // Checked for its size below.
            rows = rows.saturating_add(sh_coefficient_count(degree) as u32 - 1);
            starts.push(rows);
        }
        Self::new(starts, device)
    }

    /// The given starts, `[N + 1]`: from 0 to the number of rows.
    ///
    /// # Errors
    /// When they do not begin with 0, do not ascend by 0, 3, 8 or 15 each, or exceed 2^31 - 1.
    pub fn new(starts: Vec<u32>, device: &Device) -> Result<Self, OpError> {
        if starts.first() != Some(&0) {
            return Err(wrong(format!(
                "starts begin with 0, not with {:?}",
                starts.first()
            )));
        }
        let mut highest = 0;
        for (index, pair) in starts.windows(2).enumerate() {
            let rows = pair[1].checked_sub(pair[0]);
            let degree = rows.and_then(|rows| sh_degree_of(rows as usize));
            let Some(degree) = degree else {
                return Err(wrong(format!(
                    "Gaussian {index} has the rows {} to {}; a degree has 0, 3, 8 or 15",
                    pair[0], pair[1]
                )));
            };
            highest = highest.max(degree);
        }
        // Indices on devices are of 32 bits, with a sign.
        let indices: Result<Vec<i32>, _> =
            starts.iter().map(|start| i32::try_from(*start)).collect();
        let Ok(indices) = indices else {
            return Err(wrong("more than 2^31 - 1 coefficients".to_owned()));
        };
        let data = TensorData::new(indices, [starts.len()]);
        let device = device.clone().without_autodiff();
        Ok(Self {
            tensor: Tensor::from_data(data, (&device, DType::I32)),
            starts: starts.into(),
            highest,
        })
    }

    /// These starts for ops on a device; their tensor is copied if it is on another one.
    #[must_use]
    pub fn on(&self, device: &Device) -> Self {
        let device = device.clone().without_autodiff();
        let tensor = self.tensor.clone();
        Self {
            tensor: match tensor.device().without_autodiff() == device {
                true => tensor,
                false => tensor.to_device(&device),
            },
            ..self.clone()
        }
    }

    /// The starts, `[N + 1]`.
    pub fn starts(&self) -> &[u32] {
        &self.starts
    }

    /// The starts on the device, `[N + 1]`.
    pub(crate) fn tensor(&self) -> &Tensor<1, Int> {
        &self.tensor
    }

    /// Number of Gaussians, N.
    pub fn len(&self) -> usize {
        self.starts.len() - 1
    }

    /// True if there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Number of rows of all Gaussians, K.
    pub fn rows(&self) -> usize {
        self.starts.last().map_or(0, |rows| *rows as usize)
    }

    /// Degree of each Gaussian.
    pub fn degrees(&self) -> impl Iterator<Item = usize> + '_ {
        let rows = self.starts.windows(2).map(|pair| pair[1] - pair[0]);
        rows.map(|rows| sh_degree_of(rows as usize).unwrap_or(0))
    }

    /// Highest degree of a Gaussian.
    pub fn highest_degree(&self) -> usize {
        self.highest
    }
}

fn wrong(what: String) -> OpError {
    OpError::Argument {
        op: "ShStarts",
        what,
    }
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;

    #[test]
    fn starts_that_a_kernel_could_not_follow_are_refused() {
        let device = Device::flex();
        let refused = |starts: Vec<u32>| ShStarts::new(starts, &device).unwrap_err().to_string();
        assert!(refused(vec![]).contains("begin with 0"));
        assert!(refused(vec![3, 6]).contains("begin with 0"));
        assert!(refused(vec![0, 3, 0]).contains("Gaussian 1 has the rows 3 to 0"));
        assert!(refused(vec![0, 15, 31]).contains("Gaussian 1 has the rows 15 to 31"));
        let message = ShStarts::of_degrees([3, 4], &device).unwrap_err();
        assert!(message.to_string().contains("degree 4"), "{message}");
        let none = ShStarts::of_degrees([], &device).unwrap();
        assert_eq!((none.len(), none.rows()), (0, 0));
    }

    #[test]
    fn degrees_are_those_that_the_starts_were_made_of() {
        let degrees = [3, 0, 0, 2, 1];
        let starts = ShStarts::of_degrees(degrees, &Device::flex()).unwrap();
        assert_eq!(starts.degrees().collect::<Vec<_>>(), degrees);
        assert_eq!((starts.rows(), starts.highest_degree()), (26, 3));
        assert_eq!(starts.on(&Device::flex()).starts(), starts.starts());
    }
}
