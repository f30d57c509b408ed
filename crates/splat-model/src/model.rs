//! The interface of a trainable model: a Burn module that can be projected and coloured, and lists
//! its parameters.

use burn::module::Module;
use burn::tensor::Tensor;
use splat_data::SplatData;
use splat_ops::{OpError, Projected, ShColorSettings, ShStarts};

use crate::field::{Field, SH_COEFFICIENTS};
use crate::{CameraTensors, Gaussians, LearningRates, OwnedRows, RenderSettings};

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

    /// Rows of other row sets that belong to its Gaussians, one entry for each such set. They
    /// follow every edit of the Gaussians, which then calls
    /// [`set_owned_rows`](Self::set_owned_rows). Default none.
    fn owned_rows(&self) -> Vec<OwnedRows> {
        Vec::new()
    }

    /// Takes note of which rows of a set belong to which Gaussian, after the fields of both sets
    /// got their new rows.
    ///
    /// # Errors
    /// When the model has no such set, or another number of rows in it. An edit or a restored state
    /// has set the fields by then, so that this is a fault of the model or a damaged record.
    fn set_owned_rows(&mut self, rows: &OwnedRows) -> Result<(), OpError> {
        no_such_set("SplatModel::set_owned_rows", rows)
    }

    /// Lets each Gaussian keep at most so many of its rows of a set, the first ones. A model may
    /// have had them as one row per Gaussian of a field until then; from now on they are
    /// [`owned_rows`](Self::owned_rows).
    ///
    /// # Errors
    /// When the model has no such set, or another number of Gaussians. It is then unchanged.
    fn keep_owned_rows(&mut self, most: &OwnedRows) -> Result<(), OpError> {
        no_such_set("SplatModel::keep_owned_rows", most)
    }
}

fn no_such_set(op: &'static str, rows: &OwnedRows) -> Result<(), OpError> {
    Err(OpError::Argument {
        op,
        what: format!(
            "no rows of a set {} belong to the Gaussians of this model",
            rows.row_set()
        ),
    })
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
            let field = Field::rows("sh_rest", rates.sh_rest);
            fields.push(match &self.sh_starts {
                None => field,
                Some(_) => field.in_row_set(SH_COEFFICIENTS),
            });
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
        self.sh_starts.is_none()
    }

    fn owned_rows(&self) -> Vec<OwnedRows> {
        let starts = self.sh_starts.iter();
        let rows = |starts: &ShStarts| {
            let counts = starts.starts().windows(2).map(|pair| pair[1] - pair[0]);
            OwnedRows::of_counts(SH_COEFFICIENTS, counts)
        };
        starts.map(rows).collect()
    }

    fn set_owned_rows(&mut self, rows: &OwnedRows) -> Result<(), OpError> {
        Self::set_owned_rows(self, rows)
    }

    fn keep_owned_rows(&mut self, most: &OwnedRows) -> Result<(), OpError> {
        Self::keep_owned_rows(self, most)
    }
}
