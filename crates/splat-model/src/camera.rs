//! Cameras as tensors.

use burn::tensor::{Device, Tensor, TensorData};
use glam::DMat4;
use splat_data::{Camera, CameraModel, Lens};
use splat_ops::{Distortion, ImageSize, Intrinsics, OpError};

/// C cameras of one image size, as tensors. Call `require_grad` on them to refine poses or
/// intrinsics.
///
/// ```
/// use burn::tensor::Device;
/// use splat_model::{Camera, CameraTensors};
///
/// let camera = Camera {
///     viewmat: glam::DMat4::IDENTITY,
///     intrinsics: [50.0, 50.0, 32.0, 24.0],
///     lens: splat_model::Lens::Pinhole,
///     size: splat_model::ops::ImageSize { width: 64, height: 48 },
/// };
/// let mut cameras = CameraTensors::from_camera(&camera, &Device::flex().autodiff());
/// cameras.viewmats = cameras.viewmats.require_grad();
/// let gradients = cameras.centers().sum().backward();
/// assert!(cameras.viewmats.grad(&gradients).is_some());
/// ```
#[derive(Debug, Clone)]
pub struct CameraTensors {
    /// World to camera, `[C, 4, 4]`.
    pub viewmats: Tensor<3>,
    /// fx, fy, cx, cy in pixels, `[C, 4]`.
    pub intrinsics: Tensor<2>,
    /// Distortion of the lenses; `None` for pinhole cameras.
    pub distortion: Option<Distortion>,
    /// Image size in pixels.
    pub size: ImageSize,
}

impl CameraTensors {
    /// One camera on a device, in single precision.
    pub fn from_camera(camera: &Camera, device: &Device) -> Self {
        let rows: Vec<f32> = (0..4)
            .flat_map(|i| camera.viewmat.row(i).to_array())
            .map(|value| value as f32)
            .collect();
        let row = |values: &[f64]| {
            let values: Vec<f32> = values.iter().map(|value| *value as f32).collect();
            let shape = [1, values.len()];
            Tensor::<2>::from_data(TensorData::new(values, shape), device)
        };
        let lens = &camera.lens;
        let distortion = (!lens.coefficients().is_empty()).then(|| {
            let domain = lens.photo_domain(camera.intrinsics, camera.size);
            Distortion {
                model: lens.model(),
                coefficients: row(lens.coefficients()),
                domain: row(&[domain.limit, domain.clamp]),
            }
        });
        Self {
            viewmats: Tensor::from_data(TensorData::new(rows, [1, 4, 4]), device),
            intrinsics: row(&camera.intrinsics),
            distortion,
            size: camera.size,
        }
    }

    /// The cameras as they are now, read back; waits for the device.
    ///
    /// # Errors
    /// When the device fails, or the shapes do not fit each other.
    pub fn to_cameras(&self) -> Result<Vec<Camera>, OpError> {
        let wrong = |what: String| OpError::Device {
            op: "CameraTensors::to_cameras",
            what,
        };
        let failed = |error: &dyn core::fmt::Display| wrong(error.to_string());
        let viewmats = self.viewmats.clone().detach().try_into_vec_as::<f64>();
        let viewmats = viewmats.map_err(|error| failed(&error))?;
        let intrinsics = self.intrinsics.clone().detach().try_into_vec_as::<f64>();
        let intrinsics = intrinsics.map_err(|error| failed(&error))?;
        let (model, coefficients) = match &self.distortion {
            None => (CameraModel::Pinhole, Vec::new()),
            Some(distortion) => {
                let values = distortion.coefficients.clone().detach();
                let values = values.try_into_vec_as::<f64>();
                (distortion.model, values.map_err(|error| failed(&error))?)
            }
        };
        let width = model.coefficients();
        let cameras = viewmats.as_chunks::<16>().0.iter();
        let cameras = cameras.zip(intrinsics.as_chunks::<4>().0).enumerate();
        cameras
            .map(|(index, (viewmat, intrinsics))| {
                let own = coefficients.get(index * width..(index + 1) * width);
                let lens = own.and_then(|own| Lens::new(model, own));
                Ok(Camera {
                    viewmat: DMat4::from_cols_array(viewmat).transpose(),
                    intrinsics: *intrinsics,
                    lens: lens.ok_or_else(|| wrong("a lens lacks coefficients".to_owned()))?,
                    size: self.size,
                })
            })
            .collect()
    }

    /// The same cameras as constants, which pass no gradient on.
    #[must_use]
    pub fn detached(self) -> Self {
        Self {
            viewmats: self.viewmats.detach(),
            intrinsics: self.intrinsics.detach(),
            distortion: self.distortion.map(|distortion| Distortion {
                coefficients: distortion.coefficients.detach(),
                ..distortion
            }),
            size: self.size,
        }
    }

    /// The intrinsics with the distortion, as [`project`](splat_ops::project()) takes them.
    pub fn lens_intrinsics(&self) -> Intrinsics {
        Intrinsics {
            pinhole: self.intrinsics.clone(),
            distortion: self.distortion.clone(),
        }
    }

    /// Camera centres `[C, 3]`: `-W^T t` for `viewmat = [W | t]`. Differentiable.
    pub fn centers(&self) -> Tensor<2> {
        let upper = self.viewmats.clone().narrow(1, 0, 3);
        let rotation = upper.clone().narrow(2, 0, 3);
        let translation = upper.narrow(2, 3, 1);
        (rotation * translation).sum_dim(1).squeeze_dim(1).neg()
    }
}
