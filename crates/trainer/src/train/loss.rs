//! The loss: a closure, or a list of named, weighted terms.

use std::cell::OnceCell;

use burn::tensor::{Int, Tensor};
use splat_model::CameraTensors;
use splat_model::losses::SsimSettings;
use splat_model::ops::{OpError, Rendered, photometric, photometric_masked};

use crate::photo::values;

/// A training view, as passed to a loss.
#[derive(Debug)]
pub struct TargetView<'a> {
    /// Name of the photo.
    pub name: &'a str,
    /// Its camera.
    pub camera: &'a CameraTensors,
    /// The step, from 0.
    pub step: usize,
    pixels: Tensor<4, Int>,
    mask: Option<Tensor<4>>,
    /// Computed on demand.
    image: OnceCell<Tensor<4>>,
}

impl<'a> TargetView<'a> {
    /// A view of the photo with these levels, 0 to 255, `[1, H, W, 3]`.
    pub fn new(
        name: &'a str,
        pixels: Tensor<4, Int>,
        camera: &'a CameraTensors,
        step: usize,
    ) -> Self {
        Self {
            name,
            camera,
            step,
            pixels,
            mask: None,
            image: OnceCell::new(),
        }
    }

    /// The view with a mask `[1, H, W, 1]`, or none.
    #[must_use]
    pub fn with_mask(mut self, mask: Option<Tensor<4>>) -> Self {
        self.mask = mask;
        self
    }

    /// The mask, `[1, H, W, 1]` from 0 (ignored) to 1; `None` if all pixels count. A loss over
    /// pixels has to respect it, as [`LossTerms::l1_ssim`] does.
    pub fn mask(&self) -> Option<Tensor<4>> {
        self.mask.clone()
    }

    /// The photo, `[1, H, W, 3]` in [0, 1].
    pub fn image(&self) -> Tensor<4> {
        let make = || values(self.pixels.clone());
        self.image.get_or_init(make).clone()
    }

    /// The photo as stored, levels `[1, H, W, 3]` from 0 to 255, which [`photometric`] reads
    /// without a copy.
    pub fn pixels_u8(&self) -> Tensor<4, Int> {
        self.pixels.clone()
    }
}

/// Named, weighted terms. The loss is their weighted sum, and each is logged by name.
///
/// ```
/// use splat_trainer::LossTerms;
///
/// let loss = LossTerms::new()
///     .term("l1", 0.8, |view, rendered| Ok((rendered.image() - view.image()).abs().mean()))
///     .term("opaque", 0.1, |_, rendered| {
///         Ok(rendered.alpha().neg().add_scalar(1.0).mean())
///     });
/// ```
#[derive(Default)]
pub struct LossTerms {
    groups: Vec<Group>,
}

/// Terms measured together, as one tensor.
struct Group {
    /// Names and weights.
    terms: Vec<(String, f64)>,
    measure: Box<Measure>,
}

type Measure = dyn Fn(&TargetView, &Rendered) -> Result<Tensor<1>, OpError> + Send;

impl LossTerms {
    /// An empty list of terms.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a term: a scalar tensor `[1]`.
    pub fn term(
        self,
        name: impl Into<String>,
        weight: f64,
        term: impl Fn(&TargetView, &Rendered) -> Result<Tensor<1>, OpError> + Send + 'static,
    ) -> Self {
        self.terms([(name, weight)], term)
    }

    /// Adds several terms, with names and weights, measured by one closure as one tensor with a
    /// value per term. That avoids slicing and joining on the device, and in the gradient.
    pub fn terms(
        mut self,
        terms: impl IntoIterator<Item = (impl Into<String>, f64)>,
        measure: impl Fn(&TargetView, &Rendered) -> Result<Tensor<1>, OpError> + Send + 'static,
    ) -> Self {
        let terms = terms.into_iter();
        self.groups.push(Group {
            terms: terms.map(|(name, weight)| (name.into(), weight)).collect(),
            measure: Box::new(measure),
        });
        self
    }

    /// The loss of 3DGS (eq. 7): `(1 - weight) L1 + weight (1 - SSIM)`, over the pixels that the
    /// view's mask keeps.
    pub fn l1_ssim(ssim_weight: f64) -> Self {
        let args = SsimSettings::default().args();
        let terms = [("l1", 1.0 - ssim_weight), ("d_ssim", ssim_weight)];
        Self::new().terms(terms, move |view, rendered| {
            let (rendered, photo) = (rendered.packed(), view.pixels_u8());
            let measured = match view.mask() {
                None => photometric(rendered, photo, &args)?,
                Some(mask) => photometric_masked(rendered, photo, mask, &args)?,
            };
            Ok(measured.losses())
        })
    }

    /// Names of the terms.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        let terms = self.groups.iter().flat_map(|group| &group.terms);
        terms.map(|(name, _)| name.as_str())
    }

    /// The weighted sum, and the unweighted, detached terms in groups; `None` without terms.
    pub(super) fn evaluate(
        &self,
        view: &TargetView,
        rendered: &Rendered,
    ) -> Result<Option<(Tensor<1>, Vec<Tensor<1>>)>, OpError> {
        let mut total: Option<Tensor<1>> = None;
        let mut values = Vec::new();
        for Group { terms, measure } in &self.groups {
            let value = measure(view, rendered)?;
            if value.dims() != [terms.len()] {
                let names: Vec<_> = terms.iter().map(|(name, _)| name.as_str()).collect();
                return Err(OpError::Argument {
                    op: "loss",
                    what: format!(
                        "the terms {names:?} are measured as {:?} values; return one for each name",
                        value.dims()
                    ),
                });
            }
            values.push(value.clone().inner());
            let weighted = match &terms[..] {
                [(_, weight)] => value * *weight,
                _ => {
                    let weights: Vec<f64> = terms.iter().map(|(_, weight)| *weight).collect();
                    let at = (&value.device(), value.dtype());
                    (value * Tensor::from_data(weights.as_slice(), at)).sum()
                }
            };
            total = Some(match total {
                Some(total) => total + weighted,
                None => weighted,
            });
        }
        Ok(total.map(|total| (total, values)))
    }
}

/// A loss that [`TrainerBuilder::loss`](super::TrainerBuilder::loss) accepts.
pub trait IntoLoss {
    /// Converts to terms.
    fn into_loss(self) -> LossTerms;
}

impl IntoLoss for LossTerms {
    fn into_loss(self) -> LossTerms {
        self
    }
}

impl<F> IntoLoss for F
where
    F: Fn(&TargetView, &Rendered) -> Result<Tensor<1>, OpError> + Send + 'static,
{
    fn into_loss(self) -> LossTerms {
        LossTerms::new().term("loss", 1.0, self)
    }
}
