//! Tile rasterisation: bin, sort, blend (3DGS section 6 and appendix C).

use std::sync::OnceLock;

use burn::backend::Dispatch;
use burn::tensor::Tensor;
use tracing::trace_span;

use crate::backend::{OpInputs, RasterizeOps, RasterizeTensors};
use crate::check::Checker;
use crate::settings::RasterizeArgs;
use crate::{ErrorSlot, OpError, Projected, RasterizeSettings};

/// An image of D channels and its alpha, as [`rasterize`] returns them.
#[derive(Debug, Clone)]
pub struct Rendered {
    packed: Tensor<4>,
    /// Cut out of it when first asked for, and once: every cut is a copy, and its gradient a whole
    /// picture.
    image: OnceLock<Tensor<4>>,
    alpha: OnceLock<Tensor<4>>,
}

impl Rendered {
    /// `[C, H, W, D + 1]`: the channels, then alpha.
    pub fn packed(&self) -> Tensor<4> {
        self.packed.clone()
    }

    /// `[C, H, W, D]`: blended channels, in front of the background where one was given.
    pub fn image(&self) -> Tensor<4> {
        let [.., width] = self.packed.dims();
        let cut = || self.packed.clone().narrow(3, 0, width - 1);
        self.image.get_or_init(cut).clone()
    }

    /// The same alpha with another image of the same size, such as one whose exposure was
    /// corrected. A copy.
    ///
    /// # Errors
    /// When the image has another number of cameras, or another height or width.
    pub fn with_image(&self, image: Tensor<4>) -> Result<Self, OpError> {
        let [c, height, width, _] = self.packed.dims();
        let check = Checker::new("Rendered::with_image", "rendered", &self.packed)?;
        let expected = [Some(c), Some(height), Some(width), None];
        check.tensor("image", &image, expected, "[C, H, W, D]")?;
        Ok(Self {
            packed: Tensor::cat(vec![image, self.alpha()], 3),
            image: OnceLock::new(),
            alpha: OnceLock::new(),
        })
    }

    /// `[C, H, W, 1]`: accumulated opacity, one minus the final transmittance.
    pub fn alpha(&self) -> Tensor<4> {
        let [.., width] = self.packed.dims();
        let cut = || self.packed.clone().narrow(3, width - 1, 1);
        self.alpha.get_or_init(cut).clone()
    }
}

/// Blends splats front to back (3DGS eq. 3, appendix C).
///
/// # Arguments
/// - `projected`: from [`project`](crate::project).
/// - `colors` `[C, N, D]` or `[N, D]`: any D >= 1 of features.
/// - `opacities` `[C, N]` or `[N]`: in (0, 1).
/// - `background` `[C, D]`: blended behind the splats with the final transmittance.
///
/// Splats are ordered by depth, ties by index. Per pixel `alpha = min(alpha_max, o exp(-sigma))`; a
/// splat with less than `alpha_min` is skipped, and the pixel stops before its transmittance would
/// fall below `transmittance_min`. Every splat that was blended gets gradients, to screen mean,
/// inverse Cholesky factor, colour and opacity; depth and extent only order and cull. Splats
/// [`with_absgrad`](Projected::with_absgrad) get the absolute gradients of their means too.
///
/// ```
/// use burn::tensor::{Device, Tensor};
/// use splat_ops::{ImageSize, Projected, RasterizeSettings, rasterize};
///
/// let device = Device::flex();
/// // One round splat in the middle: mean, depth, 1 / sigma twice, compensation, extents.
/// let packed = [[[8.0, 8.0, 1.0, 0.5, 0.0, 0.5, 1.0, 6.0, 6.0]]];
/// let size = ImageSize { width: 16, height: 16 };
/// let splats = Projected::from_packed(Tensor::from_floats(packed, &device), size)?;
/// let colors = Tensor::<2>::from_floats([[1.0, 0.5, 0.0]], &device);
/// let opacities = Tensor::<1>::from_floats([0.8], &device);
/// let rendered = rasterize(&splats, colors, opacities, None, &RasterizeSettings::default())?;
/// assert_eq!(rendered.image().dims(), [1, 16, 16, 3]);
/// let middle = rendered.alpha().slice([0..1, 7..8, 7..8, 0..1]).into_scalar::<f32>();
/// assert!((middle - 0.8 * (-0.0625f32).exp()).abs() < 1e-6);
/// # Ok::<(), splat_ops::OpError>(())
/// ```
///
/// # Errors
/// When shapes, types or devices do not fit, when a setting is out of range, when the splats touch
/// more tiles than one call can list ([`OpError::TooManyIntersections`]), and when the device
/// fails.
pub fn rasterize<const DC: usize, const DO: usize>(
    projected: &Projected,
    colors: Tensor<DC>,
    opacities: Tensor<DO>,
    background: Option<Tensor<2>>,
    settings: &RasterizeSettings,
) -> Result<Rendered, OpError> {
    check_settings(settings)?;
    let packed = projected.packed();
    let (colors, opacities) = per_camera(projected, colors, opacities)?;
    let [c, _, channels] = colors.dims();
    if let Some(background) = &background {
        let check = Checker::new("rasterize", "projected", &packed)?;
        check.tensor(
            "background",
            background,
            [Some(c), Some(channels)],
            "[C, D]",
        )?;
    }

    let errors = ErrorSlot::default();
    let inputs = OpInputs(RasterizeTensors {
        packed: packed.into_dispatch(),
        colors: colors.into_dispatch(),
        opacities: opacities.into_dispatch(),
        background: background.map(Tensor::into_dispatch),
        absgrad: projected.absgrad().map(Tensor::into_dispatch),
    });
    let args = RasterizeArgs {
        size: projected.image_size(),
        settings: *settings,
        backward: false,
        errors: errors.clone(),
    };
    let span = trace_span!("rasterize").entered();
    let packed = Dispatch::rasterize(inputs, args);
    drop(span);
    if let Some(error) = errors.error() {
        return Err(error.clone());
    }
    Ok(Rendered {
        packed: Tensor::from_dispatch(packed),
        image: OnceLock::new(),
        alpha: OnceLock::new(),
    })
}

/// Behind an alpha of one there would be no light to divide by, and a splat without a least alpha
/// has no end.
pub(crate) fn check_settings(settings: &RasterizeSettings) -> Result<(), OpError> {
    let RasterizeSettings {
        alpha_min,
        alpha_max,
        transmittance_min,
        ..
    } = *settings;
    // In single precision, in which most devices compute.
    let (least, most) = (alpha_min as f32, alpha_max as f32);
    if 0.0 < least && least <= most && most < 1.0 && (0.0..1.0).contains(&transmittance_min) {
        return Ok(());
    }
    Err(OpError::Argument {
        op: "rasterize",
        what: format!(
            "settings: `alpha_min` is {alpha_min}, `alpha_max` {alpha_max} and `transmittance_min` {transmittance_min}; they must \
             be 0 < alpha_min <= alpha_max < 1 and 0 <= transmittance_min < 1"
        ),
    })
}

/// One tensor for all `cameras`, repeated for each. For one camera there is nothing to repeat, and
/// nothing to sum in the gradient.
fn repeat<const R: usize>(one: Tensor<R>, cameras: usize) -> Tensor<R> {
    match cameras {
        1 => one,
        _ => one.repeat_dim(0, cameras),
    }
}

/// Colours `[C, N, D]` and opacities `[C, N]`, checked, of what [`rasterize`] takes.
pub(crate) fn per_camera<const DC: usize, const DO: usize>(
    projected: &Projected,
    colors: Tensor<DC>,
    opacities: Tensor<DO>,
) -> Result<(Tensor<3>, Tensor<2>), OpError> {
    let packed = projected.packed();
    let [c, n, _] = packed.dims();
    let check = Checker::new("rasterize", "projected", &packed)?;

    let channels = *colors.dims().last().unwrap_or(&0);
    // N is left to `-1`: Burn's reshape reads a 0 as "keep this dimension", and N may be 0.
    let count = |length: usize| length as i32;
    let colors: Tensor<3> = match colors.dims().as_slice() {
        [cc, cn, d] if *cc == c && *cn == n && *d > 0 => {
            colors.reshape([count(c), -1, count(channels)])
        }
        [cn, d] if *cn == n && *d > 0 => repeat(colors.reshape([1, -1, count(channels)]), c),
        other => {
            return Err(OpError::Shape {
                op: "rasterize",
                tensor: "colors",
                expected: "[C, N, D] or [N, D] with D >= 1",
                got: other.to_vec(),
            });
        }
    };
    let opacities: Tensor<2> = match opacities.dims().as_slice() {
        [oc, on] if *oc == c && *on == n => opacities.reshape([count(c), -1]),
        [on] if *on == n => repeat(opacities.reshape([1, -1]), c),
        other => {
            return Err(OpError::Shape {
                op: "rasterize",
                tensor: "opacities",
                expected: "[C, N] or [N]",
                got: other.to_vec(),
            });
        }
    };
    check.tensor("colors", &colors, [None; 3], "[C, N, D]")?;
    check.tensor("opacities", &opacities, [None; 2], "[C, N]")?;
    Ok((colors, opacities))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_out_of_range_are_named() {
        let usual = RasterizeSettings::default();
        assert_eq!(check_settings(&usual), Ok(()));
        let wrong = [
            ("alpha_min", 0.0, 0.99, 1e-4),
            ("alpha_min", f64::NAN, 0.99, 1e-4),
            ("alpha_min", 0.5, 0.4, 1e-4),
            ("alpha_max", 0.01, 1.0, 1e-4),
            ("alpha_max", 0.01, 0.999_999_999, 1e-4),
            ("transmittance_min", 0.01, 0.99, -1e-4),
            ("transmittance_min", 0.01, 0.99, 1.0),
            ("transmittance_min", 0.01, 0.99, f64::NAN),
        ];
        for (name, alpha_min, alpha_max, transmittance_min) in wrong {
            let settings = RasterizeSettings {
                alpha_min,
                alpha_max,
                transmittance_min,
                ..usual
            };
            let message = check_settings(&settings).unwrap_err().to_string();
            assert!(message.contains(name), "{message}");
        }
        let never = RasterizeSettings {
            transmittance_min: 0.0,
            ..usual
        };
        assert_eq!(check_settings(&never), Ok(()));
    }
}
