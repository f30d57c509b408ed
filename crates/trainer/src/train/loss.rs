//! What is minimised: any closure, or a list of named, weighted terms.

use burn::tensor::Tensor;
use splat_model::CameraTensors;
use splat_model::losses::{SsimSettings, l1, ssim};
use splat_model::ops::{OpError, Rendered};

/// A training view as a loss sees it.
#[derive(Debug)]
pub struct TargetView<'a> {
    /// Name of the photo.
    pub name: &'a str,
    /// The photo, `[1, H, W, 3]` in [0, 1].
    pub image: Tensor<4>,
    /// Its camera.
    pub camera: &'a CameraTensors,
    /// The step, from 0.
    pub step: usize,
}

type Term = dyn Fn(&TargetView, &Rendered) -> Result<Tensor<1>, OpError> + Send;

/// Named, weighted terms; the loss is their weighted sum, and each is logged by its name.
#[derive(Default)]
pub struct LossTerms {
    terms: Vec<(String, f64, Box<Term>)>,
}

impl LossTerms {
    /// No terms yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a term: a scalar tensor `[1]`.
    pub fn term(
        mut self,
        name: impl Into<String>,
        weight: f64,
        term: impl Fn(&TargetView, &Rendered) -> Result<Tensor<1>, OpError> + Send + 'static,
    ) -> Self {
        self.terms.push((name.into(), weight, Box::new(term)));
        self
    }

    /// The loss of 3DGS (eq. 7): `(1 - weight) L1 + weight (1 - SSIM)`.
    pub fn l1_ssim(ssim_weight: f64) -> Self {
        Self::new()
            .term("l1", 1.0 - ssim_weight, |view, rendered| {
                Ok(l1(rendered.image(), view.image.clone()))
            })
            .term("d_ssim", ssim_weight, |view, rendered| {
                let similarity = ssim(
                    rendered.image(),
                    view.image.clone(),
                    &SsimSettings::default(),
                )?;
                Ok(similarity.neg() + 1.0)
            })
    }

    /// Names of the terms.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.terms.iter().map(|(name, ..)| name.as_str())
    }

    /// The weighted sum, and the terms without their weights, detached; `None` without terms.
    pub(super) fn evaluate(
        &self,
        view: &TargetView,
        rendered: &Rendered,
    ) -> Result<Option<(Tensor<1>, Vec<Tensor<1>>)>, OpError> {
        let mut total: Option<Tensor<1>> = None;
        let mut values = Vec::with_capacity(self.terms.len());
        for (_, weight, term) in &self.terms {
            let value = term(view, rendered)?;
            values.push(value.clone().inner());
            let weighted = value * *weight;
            total = Some(match total {
                Some(total) => total + weighted,
                None => weighted,
            });
        }
        Ok(total.map(|total| (total, values)))
    }
}

/// What [`TrainerBuilder::loss`](super::TrainerBuilder::loss) takes.
pub trait IntoLoss {
    /// As terms.
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
