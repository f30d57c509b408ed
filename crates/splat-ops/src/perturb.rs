//! Noise of the means, as stochastic gradient Langevin dynamics adds after every step.

use burn::backend::Dispatch;
use burn::tensor::Tensor;
use tracing::trace_span;

use crate::OpError;
use crate::backend::{OpInputs, PerturbOps, PerturbTensors};
use crate::check::Checker;
use crate::settings::Perturbation;

/// Moves every mean by noise that is shaped like its Gaussian and fades with its opacity:
/// `mean += amount sigmoid(-steepness (opacity - o)) Sigma eps`, Sigma being the covariance
/// (Kheradmand et al. 2024, *3D Gaussian Splatting as Markov Chain Monte Carlo*, section 3).
///
/// # Arguments
/// - `means` `[N, 3]`: world space.
/// - `quats` `[N, 4]`: (w, x, y, z); a Gaussian whose quaternion has no length stays where it is.
/// - `log_scales` `[N, 3]`, `opacity_logits` `[N]`: logarithms of scales, logits of opacities.
/// - `noise`: size, seed and step. The standard normal draws `eps` are a function of seed, step and
///   row, the same on every device up to rounding.
///
/// Not differentiable. One pass over memory, in place where nothing else holds the means. A
/// Gaussian whose noise is below 1e-12 of its size, such as an opaque one, stays where it is, and
/// so does one whose noise is not finite. Without a positive `amount` none moves.
///
/// ```
/// use burn::tensor::{Device, Tensor};
/// use splat_ops::{Perturbation, perturb_means};
///
/// let device = Device::flex();
/// let means = Tensor::<2>::zeros([2, 3], &device);
/// let quats = Tensor::<2>::from_floats([[1.0, 0.0, 0.0, 0.0]; 2], &device);
/// let log_scales = Tensor::<2>::zeros([2, 3], &device);
/// let logits = Tensor::<1>::from_floats([-6.0, 3.0], &device); // Faint, opaque.
/// let noise = Perturbation { amount: 0.1, opacity: 0.005, steepness: 100.0, seed: 0, step: 7 };
/// let moved = perturb_means(means, quats, log_scales, logits, &noise)?;
/// let moved: Vec<f32> = moved.into_data().try_into_vec().unwrap();
/// assert!(moved[0] != 0.0 && moved[3..] == [0.0; 3]);
/// # Ok::<(), splat_ops::OpError>(())
/// ```
///
/// # Errors
/// When shapes, types or devices do not fit.
pub fn perturb_means(
    means: Tensor<2>,
    quats: Tensor<2>,
    log_scales: Tensor<2>,
    opacity_logits: Tensor<1>,
    noise: &Perturbation,
) -> Result<Tensor<2>, OpError> {
    let check = Checker::new("perturb_means", "means", &means)?;
    let [n, _] = means.dims();
    check.tensor("means", &means, [None, Some(3)], "[N, 3]")?;
    check.tensor("quats", &quats, [Some(n), Some(4)], "[N, 4]")?;
    check.tensor("log_scales", &log_scales, [Some(n), Some(3)], "[N, 3]")?;
    check.tensor("opacity_logits", &opacity_logits, [Some(n)], "[N]")?;
    let inputs = OpInputs(PerturbTensors {
        means: means.into_dispatch(),
        quats: quats.into_dispatch(),
        log_scales: log_scales.into_dispatch(),
        opacity_logits: opacity_logits.into_dispatch(),
    });
    let _span = trace_span!("perturb").entered();
    Ok(Tensor::from_dispatch(Dispatch::perturb(inputs, *noise)))
}
