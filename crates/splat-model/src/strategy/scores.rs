//! Scores of Gaussians by what they contribute to a picture.

use burn::tensor::Tensor;
use splat_ops::{OpError, rasterize};

use crate::{CameraTensors, RenderSettings, SplatModel, project_gaussians};

/// The sum over pixels of weight times what each Gaussian contributes there, `Σ_p w_i(p) E(p)`,
/// `[N]`: `w_i` is the share of Gaussian i in the pixel (alpha times transmittance), `E` any weight
/// per pixel, `[C, H, W, 1]`, such as an error or an edge. It is the gradient of a render of one
/// channel, so it costs a forward and a backward pass.
///
/// # Errors
/// When shapes do not fit.
pub fn weighted_contributions<M: SplatModel>(
    model: &M,
    cameras: &CameraTensors,
    settings: &RenderSettings,
    weights: Tensor<4>,
) -> Result<Tensor<1>, OpError> {
    let size = cameras.size;
    let [count, _, _] = cameras.viewmats.dims();
    let expected = [count, size.height as usize, size.width as usize, 1];
    if weights.dims() != expected {
        return Err(OpError::Shape {
            op: "weighted_contributions",
            tensor: "weights",
            expected: "[C, H, W, 1]",
            got: weights.dims().to_vec(),
        });
    }
    if model.count() == 0 {
        return Ok(Tensor::zeros([0], &weights.device().without_autodiff()));
    }
    let model = model.clone().no_grad();
    let projected = project_gaussians(&model, cameras, settings)?;
    let [count, n, _] = projected.packed().dims();
    let opacities = model.opacities();
    let device = opacities.device();
    let device = device.without_autodiff().autodiff();
    let colors = Tensor::<3>::zeros([count, n, 1], &device).require_grad();
    let opacities = opacities.unsqueeze_dim::<2>(0).repeat_dim(0, count);
    let opacities = match settings.antialias {
        true => opacities * projected.compensations(),
        false => opacities,
    };
    let rendered = rasterize(
        &projected,
        colors.clone(),
        opacities,
        None,
        &settings.rasterize,
    )?;
    let weights = if weights.device().is_autodiff() {
        weights
    } else {
        Tensor::from_inner(weights)
    };
    let mut gradients = (rendered.image() * weights).sum().backward();
    let scores = colors.grad_remove(&mut gradients);
    let scores = scores.ok_or(OpError::Argument {
        op: "weighted_contributions",
        what: "the picture does not depend on the Gaussians".into(),
    })?;
    Ok(scores.sum_dim(0).reshape([n]))
}
