//! Scores of a model on held-out views.

use burn::tensor::{Device, Tensor};
use serde::Serialize;
use splat_data::View;
use splat_model::losses::{SsimSettings, psnr, psnr_masked, ssim, ssim_masked};
use splat_model::ops::OpError;
use splat_model::ops::device::to_host;
use splat_model::{
    CameraTensors, RenderSettings, SplatModel, project_gaussians, render_projected_on,
};

use crate::hooks::{HookView, Hooks, Purpose};
use crate::photo::{loaded, mask_of, pixels_u8, values};

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

/// Renders every view and compares it with its photo, over the pixels that its mask keeps. `each`
/// receives every view with its image, `H x W x 3` values clamped to [0, 1], for callers that keep
/// images. [`Trainer`](crate::Trainer) has an example.
///
/// # Errors
/// When an op refuses its input, or the device fails.
pub fn evaluate<M: SplatModel>(
    model: &M,
    views: &[&View],
    settings: &RenderSettings,
    device: &Device,
    each: impl FnMut(&View, Vec<f32>),
) -> Result<Scores, OpError> {
    evaluate_with(model, views, settings, device, &Hooks::default(), each)
}

/// [`evaluate`] with the hooks of a run.
pub(crate) fn evaluate_with<M: SplatModel>(
    model: &M,
    views: &[&View],
    settings: &RenderSettings,
    device: &Device,
    hooks: &Hooks,
    mut each: impl FnMut(&View, Vec<f32>),
) -> Result<Scores, OpError> {
    let mut scores = Vec::with_capacity(views.len());
    for view in views {
        let image = rendered(model, view, settings, device, hooks)?;
        let view = &*loaded(view)?;
        let target = values(pixels_u8(view, device));
        let scalar = |value: Tensor<1>| -> Result<f64, OpError> {
            Ok(to_host(value)?.first().copied().map_or(f64::NAN, f64::from))
        };
        let settings = SsimSettings::default();
        let [psnr, ssim] = match mask_of(view, device) {
            None => [
                psnr(image.clone(), target.clone()),
                ssim(image.clone(), target, &settings)?,
            ],
            Some(mask) => [
                psnr_masked(image.clone(), target.clone(), mask.clone()),
                ssim_masked(image.clone(), target, mask, &settings)?,
            ],
        };
        scores.push(ViewScore {
            name: view.name.clone(),
            psnr: scalar(psnr)?,
            ssim: scalar(ssim)?,
        });
        each(view, to_host(image)?);
    }
    Ok(Scores::of_views(scores))
}

/// The rendered image of a view, clamped to [0, 1].
fn rendered<M: SplatModel>(
    model: &M,
    view: &View,
    settings: &RenderSettings,
    device: &Device,
    hooks: &Hooks,
) -> Result<Tensor<4>, OpError> {
    let hook_view = HookView {
        training_index: None,
        name: &view.name,
        purpose: Purpose::HeldOut,
    };
    let camera = view.camera().relative_to(model.origin());
    let cameras = hooks.cameras(&hook_view, CameraTensors::from_camera(&camera, device))?;
    let projected = project_gaussians(model, &cameras, settings)?;
    let background = hooks.background(&hook_view, &cameras)?;
    let rendered = render_projected_on(model, &projected, &cameras, background, settings)?;
    Ok(hooks.image(&hook_view, rendered)?.image().clamp(0.0, 1.0))
}

impl Scores {
    /// Adds the means to scores of views; NaN if there are no views. A view without a score,
    /// because its mask keeps no pixel, counts in no mean.
    pub fn of_views(views: Vec<ViewScore>) -> Self {
        let mean = |score: fn(&ViewScore) -> f64| {
            let scores = views.iter().map(score).filter(|score| !score.is_nan());
            let scores: Vec<f64> = scores.collect();
            scores.iter().sum::<f64>() / scores.len() as f64
        };
        Self {
            psnr: mean(|score| score.psnr),
            ssim: mean(|score| score.ssim),
            views,
        }
    }
}
