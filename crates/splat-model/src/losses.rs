//! Image losses and metrics, as functions on tensors of images `[B, H, W, D]`.

use burn::tensor::Tensor;
use splat_ops::{OpError, gaussian_blur};

/// Mean absolute difference, `[1]`.
pub fn l1(image: Tensor<4>, target: Tensor<4>) -> Tensor<1> {
    (image - target).abs().mean()
}

/// Mean squared difference, `[1]`.
pub fn mse(image: Tensor<4>, target: Tensor<4>) -> Tensor<1> {
    (image - target).square().mean()
}

/// Peak signal-to-noise ratio in dB of images in [0, 1], `[1]`: `-10 log10(mse)`; both are clamped
/// to [0, 1] first.
pub fn psnr(image: Tensor<4>, target: Tensor<4>) -> Tensor<1> {
    mse(image.clamp(0.0, 1.0), target.clamp(0.0, 1.0)).log() * (-10.0 / core::f64::consts::LN_10)
}

/// Settings of [`ssim`]; the defaults are those of Wang et al. 2004 for images in [0, 1].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SsimSettings {
    /// Side of the Gaussian window in pixels, odd. Default 11.
    pub window: usize,
    /// Standard deviation of the window in pixels. Default 1.5.
    pub sigma: f64,
    /// K1, of the luminance term. Default 0.01.
    pub k1: f64,
    /// K2, of the contrast term. Default 0.03.
    pub k2: f64,
}

impl Default for SsimSettings {
    fn default() -> Self {
        Self {
            window: 11,
            sigma: 1.5,
            k1: 0.01,
            k2: 0.03,
        }
    }
}

impl SsimSettings {
    /// The window's weights along one axis; they sum to one.
    pub fn weights(&self) -> Vec<f64> {
        let radius = (self.window / 2) as f64;
        let weight = |i: usize| (-((i as f64 - radius) / self.sigma).powi(2) / 2.0).exp();
        let total: f64 = (0..self.window).map(weight).sum();
        (0..self.window).map(|i| weight(i) / total).collect()
    }
}

/// Mean structural similarity (Wang et al. 2004), `[1]`: over channels, and over the pixels whose
/// window lies inside the image, as scikit-image, torchmetrics and gsplat have it. In an image
/// smaller than the window every pixel counts, with zeros outside.
///
/// # Errors
/// When the window's side is even.
pub fn ssim(
    image: Tensor<4>,
    target: Tensor<4>,
    settings: &SsimSettings,
) -> Result<Tensor<1>, OpError> {
    let [_, height, width, _] = image.dims();
    let weights = settings.weights();
    let radius = settings.window / 2;
    let window = |x: Tensor<4>| -> Result<Tensor<4>, OpError> {
        let blurred = gaussian_blur(x, &weights)?;
        Ok(if height >= settings.window && width >= settings.window {
            blurred
                .narrow(1, radius, height - 2 * radius)
                .narrow(2, radius, width - 2 * radius)
        } else {
            blurred
        })
    };
    let (c1, c2) = (settings.k1.powi(2), settings.k2.powi(2));

    let mean_x = window(image.clone())?;
    let mean_y = window(target.clone())?;
    let mean_xy = mean_x.clone() * mean_y.clone();
    let mean_xx_yy = mean_x.square() + mean_y.square();
    // Of x^2 + y^2 only the sum of the two variances is needed: one window instead of two.
    let variances = window(image.clone().square() + target.clone().square())? - mean_xx_yy.clone();
    let covariance = window(image * target)? - mean_xy.clone();

    let similarity = (mean_xy * 2.0 + c1) * (covariance * 2.0 + c2);
    let scale = (mean_xx_yy + c1) * (variances + c2);
    Ok((similarity / scale).mean())
}
