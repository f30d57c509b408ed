//! Intrinsics of cameras: focal lengths, principal points, and the distortion of their lens.

use burn::tensor::{DType, Tensor, TensorData};
use splat_core::{CameraModel, ImageSize, Lens};

use crate::OpError;
use crate::check::Checker;

/// Intrinsics of C cameras. A tensor fx, fy, cx, cy `[C, 4]` in pixels converts into those of
/// pinhole cameras.
///
/// ```
/// use burn::tensor::{Device, Tensor};
/// use splat_ops::{CameraModel, Distortion, ImageSize, Intrinsics};
///
/// let device = Device::flex();
/// let size = ImageSize { width: 64, height: 48 };
/// let pinhole = Tensor::<2>::from_floats([[50.0, 50.0, 32.0, 24.0]], &device);
/// let k = Tensor::<2>::from_floats([[-0.1, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]], &device);
/// let distortion = Distortion::new(CameraModel::OpenCv, k, &pinhole, size)?;
/// let intrinsics = Intrinsics { pinhole, distortion: Some(distortion) };
/// # let _ = intrinsics;
/// # Ok::<(), splat_ops::OpError>(())
/// ```
#[derive(Debug, Clone)]
pub struct Intrinsics {
    /// fx, fy, cx, cy in pixels `[C, 4]`.
    pub pinhole: Tensor<2>,
    /// Distortion; `None` for pinhole cameras, which pay nothing for it.
    pub distortion: Option<Distortion>,
}

impl From<Tensor<2>> for Intrinsics {
    fn from(pinhole: Tensor<2>) -> Self {
        Self {
            pinhole,
            distortion: None,
        }
    }
}

/// Camera model and distortion coefficients of C cameras.
#[derive(Debug, Clone)]
pub struct Distortion {
    /// Model of all cameras.
    pub model: CameraModel,
    /// Coefficients `[C, K]`, in the order of [`CameraModel::coefficient_names`].
    pub coefficients: Tensor<2>,
    /// Domains `[C, 2]` as [`Lens::photo_domain`] has them: largest radius or angle, and radius of
    /// the clamp. A constant: it carries no gradient.
    pub domain: Tensor<2>,
}

impl Distortion {
    /// The distortion with these coefficients `[C, K]`, and the domain that follows from them, from
    /// the intrinsics fx, fy, cx, cy `[C, 4]` and the image size. Reads both tensors from the
    /// device once.
    ///
    /// # Errors
    /// When shapes do not fit, for [`CameraModel::Pinhole`], which has none, when a value is not
    /// finite, or when the device fails.
    pub fn new(
        model: CameraModel,
        coefficients: Tensor<2>,
        pinhole: &Tensor<2>,
        size: ImageSize,
    ) -> Result<Self, OpError> {
        let domain = domain(model, &coefficients, pinhole, size)?;
        Ok(Self {
            model,
            coefficients,
            domain,
        })
    }

    /// The same coefficients with the domain of what they and the intrinsics are now. Coefficients
    /// that are being trained leave their domain behind; refresh it now and then, not every step,
    /// since it waits for the device.
    ///
    /// # Errors
    /// Those of [`Distortion::new`].
    pub fn refreshed(self, pinhole: &Tensor<2>, size: ImageSize) -> Result<Self, OpError> {
        Self::new(self.model, self.coefficients, pinhole, size)
    }

    /// Checks the shapes for `c` cameras.
    pub(crate) fn check(&self, check: &Checker, c: usize) -> Result<(), OpError> {
        let Self {
            model,
            coefficients,
            domain,
        } = self;
        if *model == CameraModel::Pinhole {
            let what = "a pinhole camera has no distortion; pass None";
            return Err(check.argument(what.into()));
        }
        let k = Some(model.coefficients());
        check.tensor("distortion", coefficients, [Some(c), k], shape(*model))?;
        check.tensor("domain", domain, [Some(c), Some(2)], "[C, 2]")
    }
}

/// Shape of the coefficients, for messages.
fn shape(model: CameraModel) -> &'static str {
    match model {
        CameraModel::Pinhole => "[C, 0]",
        CameraModel::OpenCv => "[C, 8] for `opencv`",
        CameraModel::OpenCvFisheye => "[C, 4] for `opencv_fisheye`",
    }
}

fn domain(
    model: CameraModel,
    coefficients: &Tensor<2>,
    pinhole: &Tensor<2>,
    size: ImageSize,
) -> Result<Tensor<2>, OpError> {
    let check = Checker::new("Distortion", "coefficients", coefficients)?;
    let [c, k] = coefficients.dims();
    if model == CameraModel::Pinhole {
        return Err(check.argument("a pinhole camera has no distortion".into()));
    }
    let expected = [None, Some(model.coefficients())];
    check.tensor("coefficients", coefficients, expected, shape(model))?;
    check.tensor("pinhole", pinhole, [Some(c), Some(4)], "[C, 4]")?;
    let read = |name: &str, tensor: &Tensor<2>| -> Result<Vec<f64>, OpError> {
        let values = tensor.clone().detach().try_into_vec_as::<f64>();
        let values = values.map_err(|error| OpError::Device {
            op: "Distortion",
            what: error.to_string(),
        })?;
        match values.iter().position(|value| !value.is_finite()) {
            None => Ok(values),
            Some(at) => Err(check.argument(format!("`{name}` has {} at {at}", values[at]))),
        }
    };
    let (coefficients_of, intrinsics_of) = (
        read("coefficients", coefficients)?,
        read("pinhole", pinhole)?,
    );
    let cameras = coefficients_of
        .chunks_exact(k)
        .zip(intrinsics_of.chunks_exact(4));
    let domains: Vec<f64> = cameras
        .flat_map(|(coefficients, intrinsics)| {
            let lens = Lens::new(model, coefficients).unwrap_or_default();
            let domain = lens.photo_domain(std::array::from_fn(|i| intrinsics[i]), size);
            [domain.limit, domain.clamp]
        })
        .collect();
    let data = TensorData::new(domains, [c, 2]);
    let dtype: DType = coefficients.dtype();
    let device = coefficients.device().without_autodiff();
    Ok(Tensor::from_data(data, (&device, dtype)))
}
