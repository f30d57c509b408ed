//! The photometric loss of splatting: L1 and structural similarity of a rendered image and a photo.

use burn::backend::Dispatch;
use burn::tensor::{Int, Tensor};
use tracing::trace_span;

use crate::OpError;
use crate::backend::{self, PhotometricOps};
use crate::check::Checker;
use crate::settings::SsimArgs;

/// Images that [`photometric`] compares with, `[B, H, W, D]`.
#[derive(Debug, Clone)]
pub enum Target {
    /// 8-bit levels, 0 to 255, meaning `level / 255`. U8 tensors are read directly, on GPUs I32
    /// tensors too.
    Levels(Tensor<4, Int>),
    /// The values themselves.
    Values(Tensor<4>),
}

impl From<Tensor<4, Int>> for Target {
    fn from(levels: Tensor<4, Int>) -> Self {
        Self::Levels(levels)
    }
}

impl From<Tensor<4>> for Target {
    fn from(values: Tensor<4>) -> Self {
        Self::Values(values)
    }
}

/// Losses that [`photometric`] measures.
#[derive(Debug, Clone)]
pub struct Photometric {
    losses: Tensor<1>,
}

impl Photometric {
    /// Both losses, `[2]`: the mean absolute difference, and one minus the mean structural
    /// similarity (the terms of 3DGS eq. 7). Both are zero for equal images. Weighting this tensor
    /// directly is cheaper than slicing it.
    pub fn losses(&self) -> Tensor<1> {
        self.losses.clone()
    }

    /// Mean absolute difference, `[1]`.
    pub fn l1(&self) -> Tensor<1> {
        self.losses().narrow(0, 0, 1)
    }

    /// Mean structural similarity, `[1]`.
    pub fn ssim(&self) -> Tensor<1> {
        self.losses().narrow(0, 1, 1).neg() + 1.0
    }
}

/// Mean absolute difference and mean structural similarity (Wang et al. 2004, eq. 13) of rendered
/// images and a target.
///
/// Compares images `[B, H, W, E]` with a target `[B, H, W, D]` over the first D of the E channels,
/// so the packed output of [`rasterize`](crate::rasterize()) needs no slicing. The similarity is
/// that of [`ssim_map`](crate::ssim_map), averaged over channels and over the pixels whose window
/// lies inside the image, as in scikit-image, torchmetrics and gsplat. In an image smaller than the
/// window every pixel counts.
///
/// Differentiable in the images; channels beyond the first D get a gradient of zero. The target is
/// a constant.
///
/// ```
/// use burn::tensor::{Device, Int, Tensor};
/// use splat_ops::{SsimArgs, photometric};
///
/// let device = Device::flex().autodiff();
/// let rendered = Tensor::<4>::full([1, 16, 16, 3], 0.5, &device).require_grad();
/// let photo = Tensor::<4, Int>::full([1, 16, 16, 3], 255, &device);
/// let args = SsimArgs { window: vec![0.25, 0.5, 0.25], c1: 1e-4, c2: 9e-4 };
/// let measured = photometric(rendered.clone(), photo, &args)?;
/// assert_eq!(measured.l1().into_scalar::<f32>(), 0.5);
/// let loss = measured.l1() * 0.8 + (-measured.ssim() + 1.0) * 0.2;
/// assert!(rendered.grad(&loss.backward()).is_some());
/// # Ok::<(), splat_ops::OpError>(())
/// ```
///
/// # Errors
/// When shapes, types or devices do not fit, the target is tracked by autodiff, or the window is
/// not symmetric or its length is even.
pub fn photometric(
    rendered: Tensor<4>,
    target: impl Into<Target>,
    args: &SsimArgs,
) -> Result<Photometric, OpError> {
    let check = Checker::new("photometric", "rendered", &rendered)?;
    check.window(&args.window)?;
    let target = target.into();
    let [b, h, w, e] = rendered.dims();
    let d = match &target {
        Target::Levels(levels) => levels.dims()[3],
        Target::Values(values) => values.dims()[3],
    };
    let shape = [b, h, w, d.clamp(1, e.max(1))].map(Some);
    let expected = "[B, H, W, D] with 1 <= D <= E";
    let target = match target {
        Target::Levels(levels) => {
            check.place("target", &levels, shape, expected)?;
            backend::Target::Levels(levels.into_dispatch())
        }
        Target::Values(values) if values.is_tracked() => {
            return Err(check.argument(
                "`target` is a constant, but autodiff tracks it; detach it, or use `ssim_map`, which is differentiable \
                 in both images"
                    .into(),
            ));
        }
        Target::Values(values) => {
            check.tensor("target", &values, shape, expected)?;
            backend::Target::Values(values.into_dispatch())
        }
    };
    let _span = trace_span!("photometric").entered();
    let losses = Dispatch::photometric(rendered.into_dispatch(), target, args.clone());
    Ok(Photometric {
        losses: Tensor::from_dispatch(losses),
    })
}

/// [`photometric`] over the pixels that a mask keeps, as in gsplat.
///
/// The mask `[B, H, W, 1]` is 1 for pixels to keep and 0 for others. The mean absolute difference
/// is that of the kept pixels; the structural similarity is that of both images times the mask. A
/// mask that keeps nothing gives a difference of zero.
///
/// Without a mask use [`photometric`], which reads 8-bit levels directly; here the target is
/// converted to floats.
///
/// ```
/// use burn::tensor::{Device, Tensor};
/// use splat_ops::{SsimArgs, photometric_masked};
///
/// let device = Device::flex();
/// let rendered = Tensor::<4>::ones([1, 16, 16, 3], &device);
/// let target = Tensor::<4>::zeros([1, 16, 16, 3], &device);
/// // The upper half counts.
/// let kept = Tensor::<4>::ones([1, 8, 16, 1], &device);
/// let mask = Tensor::cat(vec![kept.clone(), kept.zeros_like()], 1);
/// let args = SsimArgs { window: vec![0.25, 0.5, 0.25], c1: 1e-4, c2: 9e-4 };
/// let measured = photometric_masked(rendered, target, mask, &args)?;
/// assert_eq!(measured.l1().into_scalar::<f32>(), 1.0);
/// # Ok::<(), splat_ops::OpError>(())
/// ```
///
/// # Errors
/// Those of [`photometric`], and when the mask does not fit or is tracked by autodiff.
pub fn photometric_masked(
    rendered: Tensor<4>,
    target: impl Into<Target>,
    mask: Tensor<4>,
    args: &SsimArgs,
) -> Result<Photometric, OpError> {
    let check = Checker::new("photometric_masked", "rendered", &rendered)?;
    let [b, h, w, _] = rendered.dims();
    check.tensor("mask", &mask, [b, h, w, 1].map(Some), "[B, H, W, 1]")?;
    if mask.is_tracked() {
        return Err(
            check.argument("`mask` is a constant, but autodiff tracks it; detach it".into())
        );
    }
    let values = match target.into() {
        Target::Levels(levels) => levels.float() / 255.0,
        Target::Values(values) => values,
    };
    let [.., channels] = values.dims();
    check.tensor(
        "target",
        &values,
        [Some(b), Some(h), Some(w), None],
        "[B, H, W, D]",
    )?;
    let kept = mask.clone().sum();
    // Selected rather than multiplied by zero, which would let NaN through.
    let left_out = mask.clone().equal_elem(0.0);
    let channels_rendered = rendered.dims()[3];
    let masked = rendered * mask.clone().repeat_dim(3, channels_rendered);
    let masked = masked.mask_fill(left_out.clone().repeat_dim(3, channels_rendered), 0.0);
    let values = values * mask.repeat_dim(3, channels);
    let values = values.mask_fill(left_out.repeat_dim(3, channels), 0.0);
    let losses = photometric(masked, values, args)?.losses();
    // Turns a mean over all pixels into one over the kept pixels.
    let share = kept.clamp_min(1.0).recip() * (b * h * w) as f64;
    let scale = Tensor::cat(vec![share.clone(), share.ones_like()], 0);
    Ok(Photometric {
        losses: losses * scale,
    })
}
