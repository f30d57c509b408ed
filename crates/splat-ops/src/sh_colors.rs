//! View-dependent colours of Gaussians (3DGS section 4).

use burn::backend::Dispatch;
use burn::tensor::{DType, Tensor};
use tracing::trace_span;

use crate::backend::{OpInputs, PROJECTED_WIDTH, ShColorTensors, ShColorsOps};
use crate::check::Checker;
use crate::device::reads_half;
use crate::{OpError, Projected, SH_DEGREE_MAX, ShColorSettings, sh_coefficient_count};

/// Colours `[C, N, 3]` of N Gaussians in C cameras: `max(SH(mean - centre) + 0.5, 0)`.
///
/// SH is [`spherical_harmonics`](crate::spherical_harmonics()) of the coefficients `[sh0,
/// sh_rest]`.
///
/// One pass replaces that function and the tensor ops around it, without their copies.
///
/// # Arguments
/// - `sh0` `[N, 1, 3]`: coefficients of degree 0.
/// - `sh_rest` `[N, R, 3]` with 1 + R >= (degree + 1)^2: coefficients of the higher degrees. Those
///   beyond `degree` are not read and get zero gradient; at degree 0 the tensor is not part of the
///   graph. May be half precision (F16) if autodiff does not track it, which halves the bytes
///   stored and read, rounds each coefficient to 2^-11 of itself, and leaves sums in full
///   precision.
/// - `means` `[N, 3]`: world space.
/// - `centers` `[C, 3]`: camera centres in world space.
/// - `settings`: the degree, 0 to 3, and the gradient of the clamp; a degree alone will do.
/// - `seen`: the same Gaussians projected by the same cameras. Gaussians culled there (extent zero)
///   are black and pass no gradient, and their coefficients are not read. If `None`, all colours
///   are computed.
///
/// A channel clamped at zero passes no gradient, unless
/// [`ClampGradient::Recovering`](crate::ClampGradient::Recovering) is set; a channel that is
/// exactly zero does.
///
/// ```
/// use burn::tensor::{Device, Tensor};
/// use splat_ops::sh_colors;
///
/// let device = Device::flex();
/// let sh0 = Tensor::<3>::zeros([2, 1, 3], &device);
/// let means = Tensor::<2>::ones([2, 3], &device);
/// let centers = Tensor::<2>::zeros([1, 3], &device);
/// let colors = sh_colors(sh0, None, means, centers, 0, None)?;
/// assert_eq!(colors.dims(), [1, 2, 3]); // mid-grey
/// # Ok::<(), splat_ops::OpError>(())
/// ```
///
/// # Errors
/// When the degree is above 3, or shapes, types or devices do not fit.
pub fn sh_colors(
    sh0: Tensor<3>,
    sh_rest: Option<Tensor<3>>,
    means: Tensor<2>,
    centers: Tensor<2>,
    settings: impl Into<ShColorSettings>,
    seen: Option<&Projected>,
) -> Result<Tensor<3>, OpError> {
    let settings = settings.into();
    let degree = settings.degree;
    let check = Checker::new("sh_colors", "sh0", &sh0)?;
    let [n, _, _] = sh0.dims();
    check.tensor("sh0", &sh0, [None, Some(1), Some(3)], "[N, 1, 3]")?;
    check.tensor("means", &means, [Some(n), Some(3)], "[N, 3]")?;
    check.tensor("centers", &centers, [None, Some(3)], "[C, 3]")?;
    let sh_rest = match sh_rest {
        Some(rest) => {
            let rest = readable(&check, rest, sh0.dtype())?;
            check.place("sh_rest", &rest, [Some(n), None, Some(3)], "[N, R, 3]")?;
            Some(rest)
        }
        None => None,
    };
    if degree > SH_DEGREE_MAX {
        return Err(check.argument(format!(
            "degree {degree} is not available; the highest is {SH_DEGREE_MAX}"
        )));
    }
    let stored = 1 + sh_rest.as_ref().map_or(0, |rest| rest.dims()[1]);
    if stored < sh_coefficient_count(degree) {
        return Err(check.argument(format!(
            "degree {degree} needs {} coefficients, there are {stored}",
            sh_coefficient_count(degree)
        )));
    }
    let seen = match seen {
        Some(seen) => {
            let (packed, c) = (seen.packed(), centers.dims()[0]);
            let expected = [Some(c), Some(n), Some(PROJECTED_WIDTH)];
            check.tensor("seen", &packed, expected, "[C, N, 9]")?;
            Some(packed.into_dispatch())
        }
        None => None,
    };
    let inputs = OpInputs(ShColorTensors {
        sh0: sh0.into_dispatch(),
        sh_rest: sh_rest.filter(|_| degree > 0).map(Tensor::into_dispatch),
        means: means.into_dispatch(),
        centers: centers.into_dispatch(),
        seen,
    });
    let _span = trace_span!("colours").entered();
    Ok(Tensor::from_dispatch(Dispatch::sh_colors(inputs, settings)))
}

/// Coefficients in the type that the device reads: half precision where the kernels support it,
/// else the type of the other tensors.
fn readable(check: &Checker, rest: Tensor<3>, dtype: DType) -> Result<Tensor<3>, OpError> {
    if rest.dtype() != DType::F16 {
        check.tensor("sh_rest", &rest, [None; 3], "[N, R, 3]")?;
        return Ok(rest);
    }
    if rest.is_tracked() {
        return Err(check.argument(
            "`sh_rest` is in half precision, and autodiff tracks it: gradients are too small for that; train in F32"
                .into(),
        ));
    }
    if reads_half(&rest.device()) {
        return Ok(rest);
    }
    Ok(rest.cast(dtype))
}
