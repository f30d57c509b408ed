//! The interface of a trainable model: a Burn module that can be projected and coloured, and lists
//! its parameters.

use burn::module::Module;
use burn::tensor::Tensor;
use splat_data::SplatData;
use splat_ops::{OpError, Projected, ShColorSettings};

use crate::field::Field;
use crate::{CameraTensors, Gaussians, LearningRates, RenderSettings};

/// A splat model: a Burn module that can be projected and coloured, and lists its trained
/// parameters.
///
/// [`Gaussians`] is one. Others often contain it, with additional parameters:
///
/// ```
/// # use splat_model::{CameraTensors, Field, Gaussians, LearningRates, RenderSettings, SplatModel};
/// # use splat_model::ops::{OpError, Projected};
/// # use splat_model::SplatData;
/// # use burn::tensor::Tensor;
/// use burn::module::{Module, Param};
///
/// /// Gaussians that a trained mask can make transparent.
/// #[derive(Module, Debug)]
/// struct Masked {
///     gaussians: Gaussians,
///     mask: Param<Tensor<1>>, // [N]
/// }
///
/// impl SplatModel for Masked {
///     fn origin(&self) -> [f64; 3] {
///         self.gaussians.origin
///     }
///     fn means(&self) -> Tensor<2> {
///         self.gaussians.means.val()
///     }
///     fn quats(&self) -> Tensor<2> {
///         self.gaussians.quats.val()
///     }
///     fn scales(&self) -> Tensor<2> {
///         self.gaussians.scales()
///     }
///     fn opacities(&self) -> Tensor<1> {
///         self.gaussians.opacities() * burn::tensor::activation::sigmoid(self.mask.val())
///     }
///     fn shade(
///         &self,
///         cameras: &CameraTensors,
///         projected: &Projected,
///         settings: &RenderSettings,
///     ) -> Result<Tensor<3>, OpError> {
///         self.gaussians.shade(cameras, projected, settings)
///     }
///     fn fields(&self, rates: &LearningRates) -> Vec<Field> {
///         let fields = self.gaussians.fields(rates).into_iter();
///         let mut fields: Vec<Field> = fields.map(|field| field.nested("gaussians")).collect();
///         fields.push(Field::rows("mask", 0.01));
///         fields
///     }
///     fn to_data(&self) -> SplatData {
///         self.gaussians.to_data()
///     }
/// }
/// ```
pub trait SplatModel: Module + 'static {
    /// Origin of the means in the world, see [`SplatData::origin`].
    fn origin(&self) -> [f64; 3];

    /// Centres relative to the origin, `[N, 3]`, world units.
    fn means(&self) -> Tensor<2>;

    /// Rotations (w, x, y, z) of any length, `[N, 4]`.
    fn quats(&self) -> Tensor<2>;

    /// Standard deviations along the axes, `[N, 3]`, world units.
    fn scales(&self) -> Tensor<2>;

    /// Opacities in (0, 1), `[N]`.
    fn opacities(&self) -> Tensor<1>;

    /// Colours `[C, N, 3]` for these cameras. Differentiable.
    ///
    /// # Errors
    /// When shapes do not fit.
    fn shade(
        &self,
        cameras: &CameraTensors,
        projected: &Projected,
        settings: &RenderSettings,
    ) -> Result<Tensor<3>, OpError>;

    /// The trained parameters with their learning rates, from `rates` for the fields of
    /// [`Gaussians`]. Parameters that are not listed are neither stepped nor edited.
    fn fields(&self, rates: &LearningRates) -> Vec<Field>;

    /// The scene in the form of files; parameters without a place in a file are left out.
    fn to_data(&self) -> SplatData;

    /// Number of Gaussians.
    fn count(&self) -> usize {
        self.means().dims()[0]
    }

    /// True if every Gaussian depends on its own row of each field with rows, and on nothing of
    /// other Gaussians; if centres are the field `means`, and scales the exponentials of the field
    /// `log_scales`. A step can then leave out what its views do not see, see
    /// [`SparseOptimized`](crate::SparseOptimized). Default false.
    fn is_row_wise(&self) -> bool {
        false
    }
}

impl SplatModel for Gaussians {
    fn origin(&self) -> [f64; 3] {
        self.origin
    }

    fn means(&self) -> Tensor<2> {
        self.means.val()
    }

    fn quats(&self) -> Tensor<2> {
        self.quats.val()
    }

    fn scales(&self) -> Tensor<2> {
        Self::scales(self)
    }

    fn opacities(&self) -> Tensor<1> {
        Self::opacities(self)
    }

    fn shade(
        &self,
        cameras: &CameraTensors,
        projected: &Projected,
        settings: &RenderSettings,
    ) -> Result<Tensor<3>, OpError> {
        let shading = ShColorSettings {
            degree: settings.sh_degree.min(self.sh_degree()),
            clamp_gradient: settings.clamp_gradient,
        };
        self.colors(cameras.centers(), shading, Some(projected))
    }

    fn fields(&self, rates: &LearningRates) -> Vec<Field> {
        let mut fields = vec![
            Field::rows("means", rates.means)
                .in_lengths()
                .decaying_to(rates.means_final),
            Field::rows("log_scales", rates.scales),
            Field::rows("quats", rates.quats),
            Field::rows("opacity_logits", rates.opacities),
            Field::rows("sh0", rates.sh0),
        ];
        if self.sh_rest.is_some() {
            fields.push(Field::rows("sh_rest", rates.sh_rest));
        }
        fields
    }

    fn to_data(&self) -> SplatData {
        Self::to_data(self)
    }

    fn count(&self) -> usize {
        self.len()
    }

    fn is_row_wise(&self) -> bool {
        true
    }
}
