//! View-dependent colours of Gaussians (3DGS section 4).

use burn::backend::Dispatch;
use burn::tensor::{DType, Tensor};
use tracing::trace_span;

use crate::backend::{OpInputs, PROJECTED_WIDTH, ShColorTensors, ShColorsOps, ShLayout};
use crate::check::Checker;
use crate::device::reads_half;
use crate::{OpError, Projected, SH_DEGREE_MAX, ShColorSettings, ShStarts, sh_coefficient_count};

/// Coefficients of the degrees above 0. An `Option<Tensor<3>>` converts into it.
#[derive(Debug, Clone)]
#[expect(
    clippy::large_enum_variant,
    reason = "one exists for each call, and is taken apart at once"
)]
pub enum ShRest {
    /// None: all Gaussians are of degree 0.
    None,
    /// As many of each, `[N, R, 3]`: at least `(degree + 1)^2 - 1`.
    Uniform(Tensor<3>),
    /// As many as each Gaussian's own degree takes (reduced-3dgs, Papantonakis et al. 2024).
    Ragged {
        /// Of all Gaussians, in order, `[K, 1, 3]`.
        coefficients: Tensor<3>,
        /// Which of them are whose.
        starts: ShStarts,
    },
}

impl From<Option<Tensor<3>>> for ShRest {
    fn from(rest: Option<Tensor<3>>) -> Self {
        rest.map_or(Self::None, Self::Uniform)
    }
}

/// Colours `[C, N, 3]` of N Gaussians in C cameras: `max(SH(mean - centre) + 0.5, 0)`.
///
/// SH is [`spherical_harmonics`](crate::spherical_harmonics()) of the coefficients `[sh0,
/// sh_rest]`.
///
/// One pass replaces that function and the tensor ops around it, without their copies.
///
/// # Arguments
/// - `sh0` `[N, 1, 3]`: coefficients of degree 0.
/// - `sh_rest`: coefficients of the higher degrees, `None`, `Some` tensor `[N, R, 3]` of at least
///   `(degree + 1)^2 - 1` each, or [`ShRest::Ragged`], where a Gaussian is evaluated at the lesser
///   of its own degree and `degree`. Those beyond `degree` are not read and get zero gradient; at
///   degree 0 the tensor is not part of the graph. May be half precision (F16) if autodiff does not
///   track it, which halves the bytes stored and read, rounds each coefficient to 2^-11 of itself,
///   and leaves sums in full precision.
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
    sh_rest: impl Into<ShRest>,
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
    if degree > SH_DEGREE_MAX {
        return Err(check.argument(format!(
            "degree {degree} is not available; the highest is {SH_DEGREE_MAX}"
        )));
    }
    let (sh_rest, layout, highest) = laid_out(&check, sh_rest.into(), n, &sh0, degree)?;
    let settings = ShColorSettings {
        degree: degree.min(highest),
        ..settings
    };
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
        sh_rest: sh_rest.map(Tensor::into_dispatch),
        means: means.into_dispatch(),
        centers: centers.into_dispatch(),
        seen,
    });
    let _span = trace_span!("colours").entered();
    Ok(Tensor::from_dispatch(Dispatch::sh_colors(
        inputs, layout, settings,
    )))
}

/// The coefficients that a degree reads, if any, how they belong to the `n` Gaussians, and the
/// highest degree that they have, at least `degree` unless they are ragged.
fn laid_out(
    check: &Checker,
    rest: ShRest,
    n: usize,
    sh0: &Tensor<3>,
    degree: usize,
) -> Result<(Option<Tensor<3>>, ShLayout<Dispatch>, usize), OpError> {
    let enough = |stored: usize| match stored < sh_coefficient_count(degree) {
        true => Err(check.argument(format!(
            "degree {degree} needs {} coefficients, there are {stored}",
            sh_coefficient_count(degree)
        ))),
        false => Ok(()),
    };
    match rest {
        ShRest::None => {
            enough(1)?;
            Ok((None, ShLayout::Uniform, degree))
        }
        ShRest::Uniform(rest) => {
            let rest = readable(check, rest, sh0.dtype())?;
            check.place("sh_rest", &rest, [Some(n), None, Some(3)], "[N, R, 3]")?;
            enough(1 + rest.dims()[1])?;
            Ok((Some(rest).filter(|_| degree > 0), ShLayout::Uniform, degree))
        }
        ShRest::Ragged {
            coefficients,
            starts,
        } => {
            let rest = readable(check, coefficients, sh0.dtype())?;
            let shape = [Some(starts.rows()), Some(1), Some(3)];
            check.place("sh_rest", &rest, shape, "[K, 1, 3], K as the starts say")?;
            let tensor = starts.tensor();
            check.place("starts", tensor, [Some(n + 1)], "[N + 1]")?;
            match degree.min(starts.highest_degree()) {
                0 => Ok((None, ShLayout::Uniform, 0)),
                highest => {
                    let starts = tensor.clone().into_dispatch();
                    Ok((Some(rest), ShLayout::Ragged(starts), highest))
                }
            }
        }
    }
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
