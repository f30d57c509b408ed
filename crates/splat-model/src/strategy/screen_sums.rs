//! Sums of screen gradients between two refinements, the statistics of adaptive density control.

use burn::tensor::{Device, Tensor, TensorData};
use splat_ops::device::to_host;
use splat_ops::{OpError, RowGroups, ScreenStatistics};

use super::ScreenView;
use crate::optimizer::StateRecord;

/// Per Gaussian, the sum of the lengths of its screen gradients and the number of views that saw
/// it.
#[derive(Debug, Clone, Default)]
pub(super) struct ScreenSums(Option<ScreenStatistics>);

/// Names in a checkpoint.
const GRADIENTS: &str = "gradients";
const VIEWS: &str = "views";

impl ScreenSums {
    /// Adds a view, by the gradient of its screen splats `[C, N, 9]` or their absolute gradients
    /// `[C, N, 2]`, whichever is given; those of some rows alone, if these are named. Sums over
    /// another number of Gaussians are dropped.
    pub(super) fn add(
        &mut self,
        view: &ScreenView,
        gradient: Option<&Tensor<3>>,
        rows: Option<&RowGroups>,
    ) -> Result<(), OpError> {
        let Some(gradient) = gradient.cloned() else {
            return Ok(());
        };
        let [_, splats, _] = gradient.dims();
        let n = rows.map_or(splats, RowGroups::count);
        let before = self.0.take().filter(|sums| sums.views.dims() == [n]);
        let before = before.unwrap_or_else(|| {
            let zeros = Tensor::zeros([n], (&gradient.device(), gradient.dtype()));
            ScreenStatistics {
                gradients: zeros.clone(),
                views: zeros,
            }
        });
        self.0 = Some(match rows {
            None => before.add(gradient, &view.projected)?,
            Some(rows) => before.add_rows(gradient, &view.projected, rows)?,
        });
        Ok(())
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_none()
    }

    pub(super) fn clear(&mut self) {
        self.0 = None;
    }

    /// Takes the mean gradient of each Gaussian over the views that saw it, if any view was added.
    pub(super) fn take_means(&mut self) -> Result<Option<Vec<f64>>, OpError> {
        let Some(sums) = self.0.take() else {
            return Ok(None);
        };
        let gradients = to_host(sums.gradients)?.into_iter();
        let mean = |(total, views): (f32, f32)| f64::from(total) / f64::from(views.max(1.0));
        Ok(Some(
            gradients.zip(to_host(sums.views)?).map(mean).collect(),
        ))
    }

    pub(super) fn save(&self) -> Result<StateRecord, OpError> {
        let mut record = StateRecord::default();
        if let Some(sums) = self.0.clone() {
            for (name, sum) in [(GRADIENTS, sums.gradients), (VIEWS, sums.views)] {
                let values = to_host(sum)?;
                let count = values.len();
                let data = TensorData::new(values, [count]);
                record.tensors.insert(name.to_owned(), data);
            }
        }
        Ok(record)
    }

    /// Puts back what [`save`](Self::save) gave, for this many Gaussians.
    pub(super) fn restore(
        mut record: StateRecord,
        rows: usize,
        device: &Device,
    ) -> Result<Self, String> {
        let taken = [GRADIENTS, VIEWS].map(|name| record.tensors.remove(name));
        if let Some(name) = record.tensors.keys().chain(record.scalars.keys()).next() {
            return Err(format!("`{name}` is nothing that density control keeps"));
        }
        match taken {
            [None, None] => Ok(Self(None)),
            [Some(gradients), Some(views)] => {
                let fits = |sum: &TensorData| sum.shape()[..] == [rows];
                if !fits(&gradients) || !fits(&views) {
                    return Err(format!("its sums must have shape [{rows}]"));
                }
                let [gradients, views] =
                    [gradients, views].map(|sum| Tensor::from_data(sum, device));
                Ok(Self(Some(ScreenStatistics { gradients, views })))
            }
            _ => Err(format!("of `{GRADIENTS}` and `{VIEWS}` one is missing")),
        }
    }
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;

    #[test]
    fn a_gradient_that_is_not_finite_does_not_hide_other_views() {
        let device = Device::flex();
        let size = splat_ops::ImageSize {
            width: 2,
            height: 2,
        };
        for width in [2, 9] {
            let mut sums = ScreenSums::default();
            for x in [3.0, f32::NAN, f32::INFINITY, 1.0] {
                let row = |x: f32| (0..width).map(move |i| [x, 0.0].get(i).copied().unwrap_or(9.0));
                let values: Vec<f32> = row(x).chain(row(2.0)).collect();
                let gradient = TensorData::new(values, [1, 2, width]);
                let gradient = Tensor::<3>::from_data(gradient, &device);
                let packed = Tensor::ones([1, 2, 9], &device);
                let view = ScreenView {
                    view: 0,
                    projected: splat_ops::Projected::from_packed(packed, size).unwrap(),
                    gradient: None,
                    absgrad: None,
                };
                sums.add(&view, Some(&gradient), None).unwrap();
            }
            let saved = sums.save().unwrap();
            let values = |name: &str| saved.tensors[name].try_to_vec::<f32>().unwrap();
            assert_eq!(values(GRADIENTS), [4.0, 8.0]);
            assert_eq!(values(VIEWS), [4.0, 4.0]);
        }
    }
}
