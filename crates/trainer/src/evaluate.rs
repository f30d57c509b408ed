//! Scores of a model on views it was not trained on.

use burn::tensor::{Device, Tensor};
use serde::Serialize;
use splat_data::View;
use splat_model::losses::{SsimSettings, psnr, ssim};
use splat_model::ops::OpError;
use splat_model::ops::device::to_host;
use splat_model::{CameraTensors, Gaussians, RenderSettings, render};

use crate::photo::photo;

/// Scores of one view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewScore {
    /// Name of the photo.
    pub name: String,
    /// Peak signal-to-noise ratio in dB, on images clamped to [0, 1].
    pub psnr: f64,
    /// Structural similarity, 11 x 11 Gaussian window, sigma 1.5.
    pub ssim: f64,
}

/// Scores of several views and their means.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Scores {
    /// Mean of the views' PSNR in dB.
    pub psnr: f64,
    /// Mean of the views' SSIM.
    pub ssim: f64,
    /// Per view.
    pub views: Vec<ViewScore>,
}

/// Renders every view and compares it with its photo. `each` gets every view with its picture,
/// `H x W x 3` values clamped to [0, 1], for whoever keeps pictures.
///
/// # Errors
/// When an op refuses its input, or the device fails.
pub fn evaluate(
    gaussians: &Gaussians,
    views: &[&View],
    settings: &RenderSettings,
    device: &Device,
    mut each: impl FnMut(&View, Vec<f32>),
) -> Result<Scores, OpError> {
    let mut scores = Vec::with_capacity(views.len());
    for view in views {
        let camera = view.camera().relative_to(gaussians.origin);
        let rendered = render(
            gaussians,
            &CameraTensors::from_camera(&camera, device),
            settings,
        )?;
        let image = rendered.image().clamp(0.0, 1.0);
        let target = photo(view, device);
        let scalar = |value: Tensor<1>| -> Result<f64, OpError> {
            Ok(to_host(value)?.first().copied().map_or(f64::NAN, f64::from))
        };
        scores.push(ViewScore {
            name: view.name.clone(),
            psnr: scalar(psnr(image.clone(), target.clone()))?,
            ssim: scalar(ssim(image.clone(), target, &SsimSettings::default())?)?,
        });
        each(view, to_host(image)?);
    }
    Ok(Scores::of_views(scores))
}

impl Scores {
    /// The views with their means; NaN where there is no view.
    pub fn of_views(views: Vec<ViewScore>) -> Self {
        let mean = |score: fn(&ViewScore) -> f64| {
            views.iter().map(score).sum::<f64>() / views.len() as f64
        };
        Self {
            psnr: mean(|score| score.psnr),
            ssim: mean(|score| score.ssim),
            views,
        }
    }
}
