//! View-dependent colour from spherical harmonics (3DGS section 4).

use burn::backend::Dispatch;
use burn::tensor::Tensor;
use tracing::trace_span;

pub use splat_core::{SH_DEGREE_MAX, sh_coefficient_count, sh_degree_of};

use crate::OpError;
use crate::backend::{OpInputs, SphericalHarmonicsOps, SphericalHarmonicsTensors};
use crate::check::Checker;

/// Evaluates real spherical harmonics in C x N directions.
///
/// # Arguments
/// - `coeffs` `[N, K, 3]` with K >= (degree + 1)^2; further ones are not read and get zero
///   gradient.
/// - `dirs` `[C, N, 3]`: from the camera to the Gaussian, of any length; normalised here. A
///   direction of length zero keeps degree 0 only and has no gradient.
/// - `degree`: 0 to 3.
///
/// Returns the plain sum `[C, N, 3]`, in the basis and with the constants of 3DGS. The model then
/// adds 0.5 and clamps at zero.
///
/// ```
/// use burn::tensor::{Device, Tensor};
/// use splat_ops::spherical_harmonics;
///
/// let device = Device::flex();
/// let coeffs = Tensor::<3>::ones([1, 4, 3], &device);
/// let dirs = Tensor::<3>::from_floats([[[0.0, 0.0, 2.0]]], &device);
/// let sum = spherical_harmonics(coeffs, dirs, 1)?; // [C, N, 3]
/// let red = sum.into_data().try_into_vec::<f32>().unwrap()[0];
/// assert!((red - (0.28209479 + 0.48860251)).abs() < 1e-6);
/// # Ok::<(), splat_ops::OpError>(())
/// ```
///
/// # Errors
/// When the degree is above 3, or shapes, types or devices do not fit.
pub fn spherical_harmonics(
    coeffs: Tensor<3>,
    dirs: Tensor<3>,
    degree: usize,
) -> Result<Tensor<3>, OpError> {
    let check = Checker::new("spherical_harmonics", "coeffs", &coeffs)?;
    let [n, k, _] = coeffs.dims();
    check.tensor("coeffs", &coeffs, [None, None, Some(3)], "[N, K, 3]")?;
    check.tensor("dirs", &dirs, [None, Some(n), Some(3)], "[C, N, 3]")?;
    if degree > SH_DEGREE_MAX {
        return Err(check.argument(format!(
            "degree {degree} is not available; the highest is {SH_DEGREE_MAX}"
        )));
    }
    if k < sh_coefficient_count(degree) {
        return Err(check.argument(format!(
            "degree {degree} needs {} coefficients, `coeffs` has {k}",
            sh_coefficient_count(degree)
        )));
    }
    let inputs = OpInputs(SphericalHarmonicsTensors {
        coeffs: coeffs.into_dispatch(),
        dirs: dirs.into_dispatch(),
    });
    let _span = trace_span!("spherical harmonics").entered();
    let colors = Dispatch::spherical_harmonics(inputs, degree);
    Ok(Tensor::from_dispatch(colors))
}
