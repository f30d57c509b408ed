//! Image losses and metrics, as functions on tensors of images `[B, H, W, D]`.
//!
//! ```
//! use burn::tensor::{Device, Tensor};
//! use splat_model::losses::psnr;
//!
//! let device = Device::flex();
//! let image = Tensor::<4>::full([1, 16, 16, 3], 0.5, &device);
//! let target = Tensor::<4>::full([1, 16, 16, 3], 0.6, &device);
//! assert!((psnr(image, target).into_scalar::<f32>() - 20.0).abs() < 1e-3);
//! ```

use burn::tensor::Tensor;
use derive_setters::Setters;
use splat_ops::{OpError, SsimArgs, photometric, ssim_map};

/// Mean absolute difference, `[1]`.
pub fn l1(image: Tensor<4>, target: Tensor<4>) -> Tensor<1> {
    (image - target).abs().mean()
}

/// Mean squared difference, `[1]`.
pub fn mse(image: Tensor<4>, target: Tensor<4>) -> Tensor<1> {
    (image - target).square().mean()
}

/// Peak signal-to-noise ratio in dB, `[1]`: `-10 log10(mse)` of images clamped to [0, 1].
pub fn psnr(image: Tensor<4>, target: Tensor<4>) -> Tensor<1> {
    mse(image.clamp(0.0, 1.0), target.clamp(0.0, 1.0)).log() * (-10.0 / core::f64::consts::LN_10)
}

/// [`psnr`] over the pixels that a mask `[B, H, W, 1]` keeps, from 0 (ignored) to 1; NaN if it
/// keeps none.
pub fn psnr_masked(image: Tensor<4>, target: Tensor<4>, mask: Tensor<4>) -> Tensor<1> {
    let squares = (image.clamp(0.0, 1.0) - target.clamp(0.0, 1.0)).square();
    mean_of_kept(squares, mask).log() * (-10.0 / core::f64::consts::LN_10)
}

/// Mean over the pixels that a mask `[B, H, W, 1]` keeps, and over channels.
fn mean_of_kept(values: Tensor<4>, mask: Tensor<4>) -> Tensor<1> {
    let [.., channels] = values.dims();
    let kept = mask.clone().sum() * channels as f64;
    // Selected rather than multiplied by zero, which would let NaN through.
    let ignored = mask.clone().equal_elem(0.0).repeat_dim(3, channels);
    let values = values * mask.repeat_dim(3, channels);
    values.mask_fill(ignored, 0.0).sum() / kept
}

/// Settings of structural similarity; the defaults are those of Wang et al. 2004 for images in [0,
/// 1].
#[derive(Debug, Clone, Copy, PartialEq, Setters)]
#[setters(prefix = "with_")]
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
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }

    /// The window's weights along one axis; they sum to one.
    pub fn weights(&self) -> Vec<f64> {
        let radius = (self.window / 2) as f64;
        let weight = |i: usize| (-((i as f64 - radius) / self.sigma).powi(2) / 2.0).exp();
        let total: f64 = (0..self.window).map(weight).sum();
        (0..self.window).map(|i| weight(i) / total).collect()
    }

    /// The settings in the form of the ops.
    pub fn args(&self) -> SsimArgs {
        SsimArgs {
            window: self.weights(),
            c1: self.k1.powi(2),
            c2: self.k2.powi(2),
        }
    }
}

/// Mean structural similarity (Wang et al. 2004), `[1]`, over channels and over the pixels whose
/// window lies inside the image, as in scikit-image, torchmetrics and gsplat. In an image smaller
/// than the window every pixel counts, with zeros outside. The target is a constant;
/// [`ssim_map`] is differentiable in both images.
///
/// # Errors
/// When the shapes differ, the target is tracked by autodiff, or the window size is even.
pub fn ssim(
    image: Tensor<4>,
    target: Tensor<4>,
    settings: &SsimSettings,
) -> Result<Tensor<1>, OpError> {
    Ok(photometric(image, target, &settings.args())?.ssim())
}

/// [`ssim`] over the pixels that a mask `[B, H, W, 1]` keeps, from 0 (ignored) to 1: the similarity
/// of both images times the mask, as in gsplat, and its mean over the pixels that are kept. NaN if
/// there are none.
///
/// # Errors
/// When the shapes differ or the window size is even.
pub fn ssim_masked(
    image: Tensor<4>,
    target: Tensor<4>,
    mask: Tensor<4>,
    settings: &SsimSettings,
) -> Result<Tensor<1>, OpError> {
    let [_, h, w, channels] = image.dims();
    let all = mask.clone().repeat_dim(3, channels);
    let map = ssim_map(image * all.clone(), target * all, &settings.args())?;
    // Of an image that the window fits into, the pixels whose window lies inside.
    let edge = settings.window / 2;
    let (map, mask) = match h >= settings.window && w >= settings.window {
        false => (map, mask),
        true => {
            let inside = |image: Tensor<4>| {
                let rows = image.narrow(1, edge, h - 2 * edge);
                rows.narrow(2, edge, w - 2 * edge)
            };
            (inside(map), inside(mask))
        }
    };
    Ok(mean_of_kept(map, mask))
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;
    use burn::tensor::{Device, TensorData};
    use rand::{RngExt, SeedableRng};

    const SHAPE: [usize; 4] = [2, 19, 23, 3];

    /// Two noisy images of a ramp.
    fn images() -> [Vec<f64>; 2] {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(5);
        let count = SHAPE.iter().product::<usize>();
        let mut noisy = || {
            (0..count)
                .map(|i| f64::from((i as f32 / count as f32) * 0.7 + rng.random_range(0.0..0.3f32)))
                .collect()
        };
        [noisy(), noisy()]
    }

    fn tensor(values: &[f64]) -> Tensor<4> {
        let values: Vec<f32> = values.iter().map(|v| *v as f32).collect();
        Tensor::from_data(TensorData::new(values, SHAPE), &Device::flex())
    }

    /// Wang et al. 2004, eq. 13, from its definition: one weighted sum per pixel and moment.
    fn reference_ssim(x: &[f64], y: &[f64]) -> f64 {
        let [b, h, w, d] = SHAPE;
        let weights = SsimSettings::default().weights();
        let (mut total, mut count) = (0.0, 0);
        for (image, row, column, channel) in (0..b)
            .flat_map(|i| (5..h - 5).map(move |r| (i, r)))
            .flat_map(|(i, r)| (5..w - 5).map(move |c| (i, r, c)))
            .flat_map(|(i, r, c)| (0..d).map(move |k| (i, r, c, k)))
        {
            let mut m = [0.0; 5];
            for (i, wi) in weights.iter().enumerate() {
                for (j, wj) in weights.iter().enumerate() {
                    let at = ((image * h + row + i - 5) * w + column + j - 5) * d + channel;
                    let moments = [x[at], y[at], x[at] * x[at], y[at] * y[at], x[at] * y[at]];
                    for (m, moment) in m.iter_mut().zip(moments) {
                        *m += wi * wj * moment;
                    }
                }
            }
            let [mx, my, xx, yy, xy] = m;
            let (c1, c2) = (1e-4, 9e-4);
            total += (2.0 * mx * my + c1) * (2.0 * (xy - mx * my) + c2)
                / ((mx * mx + my * my + c1) * (xx - mx * mx + yy - my * my + c2));
            count += 1;
        }
        total / f64::from(count)
    }

    #[test]
    fn ssim_agrees_with_its_definition_in_double_precision() {
        let [x, y] = images();
        let ours = ssim(tensor(&x), tensor(&y), &SsimSettings::default()).unwrap();
        let (ours, reference) = (ours.into_scalar::<f32>(), reference_ssim(&x, &y));
        assert!(
            (f64::from(ours) - reference).abs() < 2e-6,
            "{ours} {reference}"
        );
        let same = ssim(tensor(&x), tensor(&x), &SsimSettings::default()).unwrap();
        assert!((same.into_scalar::<f32>() - 1.0).abs() < 1e-6);
    }

    #[test]
    fn the_gradient_of_ssim_is_that_of_its_definition() {
        let [x, y] = images();
        let image = Tensor::from_inner(tensor(&x)).require_grad();
        let target = Tensor::from_inner(tensor(&y));
        let loss = ssim(image.clone(), target, &SsimSettings::default()).unwrap();
        let gradient = image.grad(&loss.backward()).unwrap().into_data();
        let gradient = gradient.try_into_vec::<f32>().unwrap();
        let largest = gradient.iter().fold(0.0f32, |m, g| m.max(g.abs()));
        for at in [0, 300, 700, 1311, 2000] {
            let step = |delta: f64| {
                let mut moved = x.clone();
                moved[at] += delta;
                reference_ssim(&moved, &y)
            };
            let expected = (step(1e-5) - step(-1e-5)) / 2e-5;
            let error = (f64::from(gradient[at]) - expected).abs() / f64::from(largest);
            assert!(error < 1e-5, "pixel {at}: {} and {expected}", gradient[at]);
        }
    }

    #[test]
    fn pixels_that_a_mask_ignores_change_no_score() {
        let [x, y] = images();
        let mask = Tensor::<4>::ones([2, 19, 23, 1], &Device::flex());
        let settings = SsimSettings::default();
        let scores = |x: &[f64], mask: &Tensor<4>| {
            let psnr = psnr_masked(tensor(x), tensor(&y), mask.clone());
            let ssim = ssim_masked(tensor(x), tensor(&y), mask.clone(), &settings).unwrap();
            [psnr, ssim].map(|score| score.into_scalar::<f32>())
        };
        // A mask that keeps everything changes nothing.
        let [all_psnr, all_ssim] = scores(&x, &mask);
        let plain = psnr(tensor(&x), tensor(&y)).into_scalar::<f32>();
        assert!((all_psnr - plain).abs() < 1e-4);
        let plain = ssim(tensor(&x), tensor(&y), &settings)
            .unwrap()
            .into_scalar::<f32>();
        assert!((all_ssim - plain).abs() < 1e-5);

        // The right half is ignored, whatever is there.
        let kept = mask.narrow(2, 0, 12);
        let mask = Tensor::cat(
            vec![kept, Tensor::zeros([2, 19, 11, 1], &Device::flex())],
            2,
        );
        let before = scores(&x, &mask);
        let mut spoilt = x.clone();
        for (at, value) in spoilt.iter_mut().enumerate() {
            if at / 3 % 23 >= 12 {
                *value = 1.0 - *value;
            }
        }
        assert_eq!(scores(&spoilt, &mask), before);
        assert_ne!(before, [all_psnr, all_ssim]);
        let nothing = Tensor::zeros([2, 19, 23, 1], &Device::flex());
        assert!(scores(&x, &nothing).iter().all(|score| score.is_nan()));
    }

    #[test]
    fn psnr_and_l1_are_what_they_say() {
        let [x, _] = images();
        let shifted: Vec<f64> = x.iter().map(|v| v * 0.5 + 0.2).collect();
        let expected = shifted
            .iter()
            .zip(&x)
            .map(|(a, b)| (a - b).powi(2))
            .sum::<f64>();
        let expected = -10.0 * (expected / x.len() as f64).log10();
        let ours = psnr(tensor(&shifted), tensor(&x)).into_scalar::<f32>();
        assert!(
            (f64::from(ours) - expected).abs() < 1e-3,
            "{ours} {expected}"
        );
        let lifted: Vec<f64> = x.iter().map(|v| v + 0.25).collect();
        assert!((l1(tensor(&lifted), tensor(&x)).into_scalar::<f32>() - 0.25).abs() < 1e-6);
    }
}
