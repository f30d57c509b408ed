//! Projection of 3D Gaussians to screen splats (3DGS section 4; Zwicker et al. 2001, EWA).

use burn::backend::Dispatch;
use burn::tensor::Tensor;
use tracing::trace_span;

use crate::backend::{OpInputs, PROJECTED_WIDTH, ProjectOps, ProjectTensors, ScreenProbeOps};
use crate::check::Checker;
use crate::settings::ProjectArgs;
use crate::{CameraModel, ImageSize, Intrinsics, OpError, ProjectSettings};

/// Screen splats of N Gaussians in C cameras, as [`project`] returns them.
///
/// One packed tensor `[C, N, 9]`, because an op tracked by autodiff has one output; the accessors
/// slice it with ordinary differentiable ops. Rows of culled splats are zero.
#[derive(Debug, Clone)]
pub struct Projected {
    packed: Tensor<3>,
    size: ImageSize,
    absgrad: Option<Tensor<3>>,
}

impl Projected {
    /// Splats that come from somewhere else than [`project`], for example from another camera
    /// model: `[C, N, 9]` with the columns of [`packed`](Self::packed).
    ///
    /// # Errors
    /// When the last dimension is not 9 or the image has no pixels.
    pub fn from_packed(packed: Tensor<3>, size: ImageSize) -> Result<Self, OpError> {
        let check = Checker::new("Projected", "packed", &packed)?;
        check.tensor(
            "packed",
            &packed,
            [None, None, Some(PROJECTED_WIDTH)],
            "[C, N, 9]",
        )?;
        check_size(&check, size)?;
        Ok(Self {
            packed,
            size,
            absgrad: None,
        })
    }

    /// `[C, N, 9]`: mean x, mean y, depth, w11, w21, w22, compensation, extent x, extent y.
    pub fn packed(&self) -> Tensor<3> {
        self.packed.clone()
    }

    /// Screen means `[C, N, 2]`, in pixels.
    pub fn means2d(&self) -> Tensor<3> {
        self.columns(0, 2)
    }

    /// Depth `[C, N]`, in world units: camera z, or the distance for a fisheye.
    pub fn depths(&self) -> Tensor<2> {
        self.columns(2, 1).squeeze_dim(2)
    }

    /// Inverse Cholesky factor (w11, w21, w22) `[C, N, 3]` of the 2D covariance, in 1 / pixels:
    /// a pixel at offset (dx, dy) from the mean has
    /// `sigma = ((w11 dx)^2 + (w21 dx + w22 dy)^2) / 2`.
    pub fn inverse_cholesky(&self) -> Tensor<3> {
        self.columns(3, 3)
    }

    /// `[C, N]`: the factor `sqrt(det before / det after the low-pass filter)` by which
    /// anti-aliased rendering multiplies the opacity (Yu et al. 2024, Mip-Splatting).
    pub fn compensations(&self) -> Tensor<2> {
        self.columns(6, 1).squeeze_dim(2)
    }

    /// Half sizes `[C, N, 2]` of the box that holds every pixel with alpha >= `alpha_min`, in
    /// pixels; zero for culled splats. Carries no gradient.
    pub fn extents(&self) -> Tensor<3> {
        self.columns(7, 2).detach()
    }

    /// The image these splats are for.
    pub fn image_size(&self) -> ImageSize {
        self.size
    }

    /// The same splats, and a leaf `[C, N, 9]` tied to them, whose gradient after the backward pass
    /// is theirs: its first two columns are that of the screen means, which density control reads
    /// (3DGS section 5.2). The leaf lies in the memory of the splats, and its gradient in that of
    /// theirs: nothing is copied.
    pub fn with_screen_probe(self) -> (Self, Tensor<3>) {
        let probe = tracked(self.packed.clone().detach());
        let packed =
            Dispatch::screen_probe(self.packed.into_dispatch(), probe.clone().into_dispatch());
        let probed = Self {
            packed: Tensor::from_dispatch(packed),
            ..self
        };
        (probed, probe)
    }

    /// The same splats, and a leaf `[C, N, 2]` whose gradient, after the backward pass of a
    /// [`rasterize`](crate::rasterize()) of them, is the sum over pixels of the absolute value of
    /// each pixel's gradient by the screen mean, x and y apart, in 1 / pixels (Ye et al. 2024,
    /// *AbsGS: Recovering Fine Details for 3D Gaussian Splatting*, eq. 9). Where pixels pull a
    /// splat apart, their gradients cancel in that of the mean; here they add up.
    ///
    /// It costs two sums per pixel and splat in the backward pass; splats without the leaf pay
    /// nothing. Rasterised several times, they have the sum of the sums. A second call replaces the
    /// leaf of the first.
    ///
    /// ```
    /// use burn::tensor::{Device, Tensor};
    /// use splat_ops::{ImageSize, Projected, RasterizeSettings, rasterize};
    ///
    /// let device = Device::flex().autodiff();
    /// let packed = [[[8.0, 8.0, 1.0, 0.5, 0.0, 0.5, 1.0, 6.0, 6.0]]];
    /// let size = ImageSize { width: 16, height: 16 };
    /// let packed = Tensor::<3>::from_floats(packed, &device).require_grad();
    /// let (splats, absgrad) = Projected::from_packed(packed.clone(), size)?.with_absgrad();
    /// let colors = Tensor::<2>::from_floats([[1.0]], &device);
    /// let opacities = Tensor::<1>::from_floats([0.8], &device);
    /// let rendered = rasterize(&splats, colors, opacities, None, &RasterizeSettings::default())?;
    /// let gradients = rendered.image().sum().backward();
    /// let of_mean = packed.grad(&gradients).unwrap().into_data().try_into_vec::<f32>().unwrap();
    /// let absolute = absgrad.grad(&gradients).unwrap().into_data().try_into_vec::<f32>().unwrap();
    /// assert!(of_mean[0].abs() < 1e-4); // Left and right cancel.
    /// assert!(absolute[0] > 1.0);
    /// # Ok::<(), splat_ops::OpError>(())
    /// ```
    pub fn with_absgrad(self) -> (Self, Tensor<3>) {
        let [c, n, _] = self.packed.dims();
        let options = (&self.packed.device(), self.packed.dtype());
        let leaf = tracked(Tensor::zeros([c, n, 2], options));
        let probed = Self {
            absgrad: Some(leaf.clone()),
            ..self
        };
        (probed, leaf)
    }

    /// The leaf of [`with_absgrad`](Self::with_absgrad).
    pub(crate) fn absgrad(&self) -> Option<Tensor<3>> {
        self.absgrad.clone()
    }

    fn columns(&self, start: usize, length: usize) -> Tensor<3> {
        self.packed.clone().narrow(2, start, length)
    }
}

/// A leaf that gets a gradient, where the device has autodiff; elsewhere nothing does.
fn tracked(leaf: Tensor<3>) -> Tensor<3> {
    match leaf.device().is_autodiff() {
        true => leaf.require_grad(),
        false => leaf,
    }
}

/// Projects Gaussians to screen splats (3DGS eq. 5, the affine approximation of EWA splatting).
///
/// # Arguments
/// - `means` `[N, 3]`: world space.
/// - `quats` `[N, 4]`: (w, x, y, z), any non-zero length; normalised here.
/// - `scales` `[N, 3]`: linear standard deviations, world units.
/// - `viewmats` `[C, 4, 4]`: world to camera. The gradient treats the upper twelve entries as
///   independent; the bottom row's is zero.
/// - `intrinsics`: fx, fy, cx, cy `[C, 4]` in pixels, or [`Intrinsics`] with the distortion of a
///   lens, whose coefficients have a gradient like every other input.
/// - `size`: image size, for culling and for the clamp of the Jacobian.
///
/// The screen mean is that of the camera model, exactly; J is the model's Jacobian at the mean. For
/// perspective cameras it is evaluated inside the image and a margin around it, because EWA's
/// approximation explodes beyond. The 2D covariance is `V V^T + eps2d I`, V = J W R diag(s), with
/// its determinant from the minors of V, which keeps needles exact in single precision. Splats are
/// culled (row of zeros, no gradient) when their depth is outside [near, far], when they are
/// outside of the lens's domain, when they do not reach the image, when their quaternion has no
/// length, or when one of their fields is not finite.
///
/// ```
/// use burn::tensor::{Device, Tensor};
/// use splat_ops::{ImageSize, ProjectSettings, project};
///
/// let device = Device::flex().autodiff();
/// let means = Tensor::<2>::from_floats([[0.0, 0.0, 4.0]], &device).require_grad();
/// let projected = project(
///     means.clone(),
///     Tensor::from_floats([[1.0, 0.0, 0.0, 0.0]], &device), // quats
///     Tensor::from_floats([[0.1, 0.1, 0.1]], &device),      // scales
///     Tensor::<2>::eye(4, &device).unsqueeze(),             // viewmats
///     Tensor::from_floats([[50.0, 50.0, 32.0, 24.0]], &device),
///     ImageSize { width: 64, height: 48 },
///     &ProjectSettings::default(),
/// )?;
/// let mean2d: Vec<f32> = projected.means2d().into_data().try_into_vec().unwrap();
/// assert_eq!(mean2d, [32.0, 24.0]);
/// let gradient = means.grad(&projected.means2d().sum().backward()).unwrap();
/// assert_eq!(gradient.into_data().try_into_vec::<f32>().unwrap()[0], 50.0 / 4.0);
/// # Ok::<(), splat_ops::OpError>(())
/// ```
///
/// # Errors
/// When shapes, types or devices do not fit, or the image has no pixels.
pub fn project(
    means: Tensor<2>,
    quats: Tensor<2>,
    scales: Tensor<2>,
    viewmats: Tensor<3>,
    intrinsics: impl Into<Intrinsics>,
    size: ImageSize,
    settings: &ProjectSettings,
) -> Result<Projected, OpError> {
    let Intrinsics {
        pinhole: intrinsics,
        distortion,
    } = intrinsics.into();
    let check = Checker::new("project", "means", &means)?;
    let [n, _] = means.dims();
    let [c, _, _] = viewmats.dims();
    check.tensor("means", &means, [None, Some(3)], "[N, 3]")?;
    check.tensor("quats", &quats, [Some(n), Some(4)], "[N, 4]")?;
    check.tensor("scales", &scales, [Some(n), Some(3)], "[N, 3]")?;
    check.tensor("viewmats", &viewmats, [None, Some(4), Some(4)], "[C, 4, 4]")?;
    check.tensor("intrinsics", &intrinsics, [Some(c), Some(4)], "[C, 4]")?;
    if let Some(distortion) = &distortion {
        distortion.check(&check, c)?;
    }
    check_size(&check, size)?;
    if c == 0 {
        return Err(check.argument("needs at least one camera".into()));
    }

    let model = (distortion.as_ref()).map_or(CameraModel::Pinhole, |distortion| distortion.model);
    let (coefficients, domain) = distortion.map(|d| (d.coefficients, d.domain)).unzip();
    let inputs = OpInputs(ProjectTensors {
        means: means.into_dispatch(),
        quats: quats.into_dispatch(),
        scales: scales.into_dispatch(),
        viewmats: viewmats.into_dispatch(),
        intrinsics: intrinsics.into_dispatch(),
        distortion: coefficients.map(Tensor::into_dispatch),
        domain: domain.map(|domain| domain.detach().into_dispatch()),
    });
    let args = ProjectArgs {
        size,
        model,
        settings: *settings,
    };
    let _span = trace_span!("project").entered();
    let packed = Dispatch::project(inputs, args);
    Ok(Projected {
        packed: Tensor::from_dispatch(packed),
        size,
        absgrad: None,
    })
}

/// An image needs pixels, and pixel coordinates must be exact in single precision.
fn check_size(check: &Checker, size: ImageSize) -> Result<(), OpError> {
    const LARGEST: u32 = 65_536;
    let side = 1..=LARGEST;
    if side.contains(&size.width) && side.contains(&size.height) {
        return Ok(());
    }
    Err(check.argument(format!(
        "an image of {} x {} pixels; each side must be 1 to {LARGEST}",
        size.width, size.height
    )))
}
