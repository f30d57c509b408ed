//! Statistics of every step for density control (3DGS section 5.2).

use burn::backend::Dispatch;
use burn::tensor::Tensor;

use crate::backend::{OpInputs, PROJECTED_WIDTH, ScreenStatisticsOps, ScreenStatisticsTensors};
use crate::check::Checker;
use crate::settings::RowGroups;
use crate::{OpError, Projected};

/// Sums over the views so far, per Gaussian.
#[derive(Debug, Clone)]
pub struct ScreenStatistics {
    /// `[N]`: lengths of the gradients of the screen means, in half images, as gsplat measures
    /// them.
    pub gradients: Tensor<1>,
    /// `[N]`: views that saw the Gaussian.
    pub views: Tensor<1>,
}

impl ScreenStatistics {
    /// Adds a step: splats, and the gradient of a loss that is a mean over C cameras, either of
    /// their packed rows `[C, N, 9]`, as [`Projected::with_screen_probe`] gives it, or of their
    /// screen means `[C, N, 2]`, as [`Projected::with_absgrad`] does. The first two columns count,
    /// in 1 / pixels, where the extent says that a camera sees the Gaussian. A gradient that is not
    /// finite counts as zero. One pass over memory, in place where nothing else holds the
    /// statistics. Not differentiable.
    ///
    /// # Errors
    /// When shapes, types or devices do not fit.
    pub fn add(self, gradient: Tensor<3>, projected: &Projected) -> Result<Self, OpError> {
        self.add_to(gradient, projected, None)
    }

    /// [`add`](Self::add) of the splats of some rows alone, N' of N: gradient `[C, N', 9]` or `[C,
    /// N', 2]`, splats `[C, N', 9]`. The sums of others stay as they are.
    ///
    /// # Errors
    /// When shapes, types or devices do not fit, or the rows are those of another number of
    /// Gaussians.
    pub fn add_rows(
        self,
        gradient: Tensor<3>,
        projected: &Projected,
        rows: &RowGroups,
    ) -> Result<Self, OpError> {
        self.add_to(gradient, projected, Some(rows))
    }

    fn add_to(
        self,
        gradient: Tensor<3>,
        projected: &Projected,
        rows: Option<&RowGroups>,
    ) -> Result<Self, OpError> {
        // Autodiff has no part in this.
        let (gradient, packed) = (gradient.inner(), projected.packed().inner());
        let check = Checker::new("ScreenStatistics::add", "gradient", &gradient)?;
        let [c, splats, width] = gradient.dims();
        let shape = [Some(c), Some(splats), Some(PROJECTED_WIDTH)];
        if width != 2 {
            check.tensor("gradient", &gradient, shape, "[C, N, 9] or [C, N, 2]")?;
        }
        check.tensor("projected", &packed, shape, "[C, N, 9]")?;
        let n = rows.map_or(splats, RowGroups::count);
        if let Some(rows) = rows.filter(|rows| rows.len() != splats) {
            let rows = rows.len();
            return Err(check.argument(format!("{splats} splats of {rows} rows")));
        }
        check.tensor("gradients", &self.gradients, [Some(n)], "[N]")?;
        check.tensor("views", &self.views, [Some(n)], "[N]")?;
        // Pixels to half images, and the mean over cameras to a sum.
        let size = projected.image_size();
        let half = [size.width, size.height].map(|side| f64::from(side) / 2.0 * c as f64);
        let inputs = OpInputs(ScreenStatisticsTensors {
            gradient: gradient.into_dispatch(),
            packed: packed.into_dispatch(),
            gradients: self.gradients.into_dispatch(),
            views: self.views.into_dispatch(),
        });
        let sums = Dispatch::add_screen_statistics(inputs, half, rows.cloned());
        Ok(Self {
            gradients: Tensor::from_dispatch(sums.gradients),
            views: Tensor::from_dispatch(sums.views),
        })
    }
}
