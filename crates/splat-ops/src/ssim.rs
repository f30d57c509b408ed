//! Structural similarity per pixel (Wang et al. 2004, eq. 13).

use core::ops::Range;

use burn::backend::Dispatch;
use burn::tensor::Tensor;
use tracing::trace_span;

use crate::OpError;
use crate::backend::{OpInputs, SsimOps, SsimTensors};
use crate::check::Checker;
use crate::settings::SsimArgs;

/// Structural similarity of two images `[B, H, W, D]` at every pixel and channel; zero outside the
/// images.
///
/// ```text
/// S = (2 mx my + c1) (2 (E[xy] - mx my) + c2) / ((mx^2 + my^2 + c1) (E[x^2 + y^2] - mx^2 - my^2 + c2))
/// ```
///
/// Here m and E are means under the window. Differentiable in both images.
///
/// ```
/// use burn::tensor::{Device, Tensor};
/// use splat_ops::{SsimArgs, ssim_map};
///
/// let image = Tensor::<4>::ones([1, 8, 8, 3], &Device::flex());
/// let args = SsimArgs { window: vec![0.25, 0.5, 0.25], c1: 1e-4, c2: 9e-4 };
/// let map = ssim_map(image.clone(), image, &args)?;
/// assert!(map.into_data().try_into_vec::<f32>().unwrap().iter().all(|s| (s - 1.0).abs() < 1e-5));
/// # Ok::<(), splat_ops::OpError>(())
/// ```
///
/// # Errors
/// When shapes, types or devices differ, or the window is not symmetric or its length is even.
pub fn ssim_map(x: Tensor<4>, y: Tensor<4>, args: &SsimArgs) -> Result<Tensor<4>, OpError> {
    let check = Checker::new("ssim_map", "x", &x)?;
    check.tensor("y", &y, x.dims().map(Some), "that of `x`")?;
    check.window(&args.window)?;
    let inputs = OpInputs(SsimTensors {
        x: x.into_dispatch(),
        y: y.into_dispatch(),
    });
    let _span = trace_span!("ssim").entered();
    Ok(Tensor::from_dispatch(Dispatch::ssim(inputs, args.clone())))
}

/// Rows and columns of the pixels of a `[height, width]` image whose window lies inside; all of
/// them if none does.
pub(crate) fn counted([height, width]: [usize; 2], window: usize) -> [Range<usize>; 2] {
    let radius = if height < window || width < window {
        0
    } else {
        window / 2
    };
    [height, width].map(|length| radius..length - radius)
}
