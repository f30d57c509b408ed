//! The three ops composed: from Gaussians and a camera to an image.

use burn::tensor::Tensor;
use derive_setters::Setters;
use splat_data::SplatData;
use splat_ops::{
    ClampGradient, OpError, ProjectSettings, Projected, RasterizeSettings, Rendered, SH_DEGREE_MAX,
    project, rasterize,
};

use crate::{CameraTensors, SplatModel};

/// Render settings.
#[derive(Debug, Clone, PartialEq, Setters)]
#[setters(prefix = "with_", strip_option)]
pub struct RenderSettings {
    /// Highest degree of spherical harmonics to evaluate, limited by the model. Default 3, which
    /// means all.
    pub sh_degree: usize,
    /// Gradient of the clamp of colours at zero. Default exact; use [`ClampGradient::Recovering`]
    /// for training.
    pub clamp_gradient: ClampGradient,
    /// Multiplies opacities by the compensation of the low-pass filter (Yu et al. 2024,
    /// Mip-Splatting). Default false.
    pub antialias: bool,
    /// Background colour. `None` is black, at no cost.
    pub background: Option<[f32; 3]>,
    /// Settings of the projection.
    pub project: ProjectSettings,
    /// Settings of the rasteriser.
    pub rasterize: RasterizeSettings,
}

impl Default for RenderSettings {
    fn default() -> Self {
        Self {
            sh_degree: SH_DEGREE_MAX,
            clamp_gradient: ClampGradient::default(),
            antialias: false,
            background: None,
            project: ProjectSettings::default(),
            rasterize: RasterizeSettings::default(),
        }
    }
}

impl RenderSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }
}

impl RenderSettings {
    /// Settings that render a scene as it was trained, from its file, up to its degree of spherical
    /// harmonics. If the file does not say: without anti-aliasing, on black.
    pub fn of_scene(scene: &SplatData) -> Self {
        let settings = &scene.settings;
        Self {
            sh_degree: scene.sh_degree,
            project: scene.scene_scale().project_settings(),
            antialias: settings.antialias.unwrap_or_default(),
            // `None` gives black at no cost.
            background: settings.background.filter(|color| *color != [0.0; 3]),
            ..Self::default()
        }
    }
}

/// Renders Gaussians in C cameras: image `[C, H, W, 3]` and alpha `[C, H, W, 1]`.
///
/// # Errors
/// Those of [`project`] and [`rasterize`].
pub fn render<M: SplatModel>(
    model: &M,
    cameras: &CameraTensors,
    settings: &RenderSettings,
) -> Result<Rendered, OpError> {
    let projected = project_gaussians(model, cameras, settings)?;
    render_projected(model, &projected, cameras, settings)
}

/// The first half of [`render`]: screen splats.
///
/// # Errors
/// Those of [`project`].
pub fn project_gaussians<M: SplatModel>(
    model: &M,
    cameras: &CameraTensors,
    settings: &RenderSettings,
) -> Result<Projected, OpError> {
    project(
        model.means(),
        model.quats(),
        model.scales(),
        cameras.viewmats.clone(),
        cameras.lens_intrinsics(),
        cameras.size,
        &settings.project,
    )
}

/// The second half of [`render`]: colours and blending. Screen probes, or anything else, can go
/// between the halves.
///
/// # Errors
/// Those of [`sh_colors`](splat_ops::sh_colors()) and [`rasterize`].
pub fn render_projected<M: SplatModel>(
    model: &M,
    projected: &Projected,
    cameras: &CameraTensors,
    settings: &RenderSettings,
) -> Result<Rendered, OpError> {
    render_projected_on(model, projected, cameras, None, settings)
}

/// [`render_projected`] on a background `[C, 3]` instead of that of the settings.
///
/// # Errors
/// Those of [`render_projected`], and when the background does not fit.
pub fn render_projected_on<M: SplatModel>(
    model: &M,
    projected: &Projected,
    cameras: &CameraTensors,
    background: Option<Tensor<2>>,
    settings: &RenderSettings,
) -> Result<Rendered, OpError> {
    let colors = model.shade(cameras, projected, settings)?;
    let [count, _, _] = colors.dims();
    let background = background.or_else(|| {
        let color = Tensor::<1>::from_floats(settings.background?, &colors.device());
        Some(color.reshape([1, 3]).repeat_dim(0, count))
    });
    let opacities = model.opacities();
    if settings.antialias {
        // `-1` and a repeat instead of a broadcast, because N may be 0.
        let opacities = opacities.reshape([1, -1]).repeat_dim(0, count);
        let opacities = opacities * projected.compensations();
        return rasterize(
            projected,
            colors,
            opacities,
            background,
            &settings.rasterize,
        );
    }
    rasterize(
        projected,
        colors,
        opacities,
        background,
        &settings.rasterize,
    )
}
