//! Separable Gaussian window over images, the building block of SSIM (Wang et al. 2004).

use burn::backend::Dispatch;
use burn::tensor::Tensor;
use tracing::trace_span;

use crate::OpError;
use crate::backend::BlurOps;
use crate::check::Checker;

/// Convolves the rows and columns of images `[B, H, W, D]` with a symmetric window; zero outside
/// the image. Differentiable in the image; the op is self-adjoint, so it is its own gradient.
///
/// ```
/// use burn::tensor::{Device, Tensor};
///
/// let image = Tensor::<4>::ones([1, 5, 5, 1], &Device::flex());
/// let blurred = splat_ops::gaussian_blur(image, &[0.25, 0.5, 0.25])?;
/// let values: Vec<f32> = blurred.into_data().try_into_vec().unwrap();
/// assert_eq!((values[12], values[0]), (1.0, 0.75 * 0.75)); // zeros outside of the image
/// # Ok::<(), splat_ops::OpError>(())
/// ```
///
/// # Errors
/// When the window is not symmetric or its length is even.
pub fn gaussian_blur(image: Tensor<4>, window: &[f64]) -> Result<Tensor<4>, OpError> {
    let check = Checker::new("gaussian_blur", "image", &image)?;
    check.window(window)?;
    let _span = trace_span!("blur").entered();
    let blurred = Dispatch::gaussian_blur(image.into_dispatch(), window.to_vec());
    Ok(Tensor::from_dispatch(blurred))
}
