//! The model: 3D Gaussians as a Burn module (3DGS section 4).

use burn::module::{Module, Param};
use burn::tensor::{DType, Device, Tensor, TensorData};
use splat_ops::device::reads_half;
use splat_ops::{
    OpError, Projected, SH_DEGREE_MAX, ShColorSettings, ShRest, ShStarts, exp,
    sh_coefficient_count, sh_colors, sigmoid,
};

use splat_data::{SceneSettings, SplatData};

/// N Gaussians. Parameters are stored before activation, as in 3DGS: scales as logarithms,
/// opacities as logits.
///
/// ```
/// use burn::tensor::Device;
/// use splat_model::{CameraTensors, Gaussians, RenderSettings, SceneScale, render};
/// use splat_model::{InitSettings, splats_from_points};
///
/// let device = Device::flex();
/// let points = [[0.0, 0.0, 4.0], [0.5, 0.0, 5.0]];
/// let scale = SceneScale::new(4.0).unwrap();
/// let splats = splats_from_points(&points, &[[255, 0, 0], [0, 0, 255]], scale, &InitSettings::new())?;
/// let gaussians = Gaussians::from_data(&splats, &device);
/// let camera = splat_model::Camera {
///     viewmat: glam::DMat4::IDENTITY,
///     intrinsics: [50.0, 50.0, 32.0, 24.0],
///     lens: splat_model::Lens::Pinhole,
///     size: splat_model::ops::ImageSize { width: 64, height: 48 },
/// };
/// let camera = CameraTensors::from_camera(&camera, &device);
/// let image = render(&gaussians, &camera, &RenderSettings::new())?.image();
/// assert_eq!(image.dims(), [1, 48, 64, 3]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Module, Debug)]
pub struct Gaussians {
    /// Origin of the means in the world, see [`SplatData::origin`]. Cameras must be relative to it
    /// too: [`Camera::relative_to`](crate::Camera::relative_to).
    #[module(skip)]
    pub origin: [f64; 3],
    /// Centres relative to the origin, `[N, 3]`, world units.
    pub means: Param<Tensor<2>>,
    /// Logarithms of the standard deviations along the axes, `[N, 3]`.
    pub log_scales: Param<Tensor<2>>,
    /// Rotations (w, x, y, z) of any length, `[N, 4]`.
    pub quats: Param<Tensor<2>>,
    /// Logits of the opacities, `[N]`.
    pub opacity_logits: Param<Tensor<1>>,
    /// Spherical harmonics of degree 0, `[N, 1, 3]`.
    pub sh0: Param<Tensor<3>>,
    /// Spherical harmonics of the higher degrees, `[N, (degree + 1)^2 - 1, 3]`; absent for degree
    /// 0. Where Gaussians have different degrees, those of each Gaussian's own, `[K, 1, 3]`.
    pub sh_rest: Option<Param<Tensor<3>>>,
    /// The first row of each Gaussian in `sh_rest`, where Gaussians have different degrees; see
    /// [`with_sh_degrees`](Self::with_sh_degrees).
    #[module(skip)]
    pub sh_starts: Option<ShStarts>,
}

/// Storage precision of the higher degrees of spherical harmonics, 45 of the 59 floats of a degree
/// 3 Gaussian.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ShPrecision {
    /// In single precision.
    #[default]
    Exact,
    /// In half precision, for rendering only. A Gaussian of degree 3 takes 146 bytes instead of
    /// 236, and colours read 114 bytes instead of 204 (`docs/notes/half-precision.md`).
    Half,
}

/// Largest half-precision number.
const HALF_MAX: f32 = 65_504.0;

impl Gaussians {
    /// A model without Gaussians.
    pub fn empty(device: &Device) -> Self {
        Self::from_data(&SplatData::default(), device)
    }

    /// Uploads a scene to a device.
    pub fn from_data(data: &SplatData, device: &Device) -> Self {
        let n = data.means.len();
        let tensor2 = |values: Vec<f32>, width: usize| {
            Param::from_tensor(Tensor::<2>::from_data(
                TensorData::new(values, [n, width]),
                device,
            ))
        };
        let rest = sh_coefficient_count(data.sh_degree) - 1;
        Self {
            origin: data.origin,
            means: tensor2(data.means.as_flattened().to_vec(), 3),
            log_scales: tensor2(data.log_scales.as_flattened().to_vec(), 3),
            quats: tensor2(data.quats.as_flattened().to_vec(), 4),
            opacity_logits: Param::from_tensor(Tensor::from_data(
                TensorData::new(data.opacity_logits.clone(), [n]),
                device,
            )),
            sh0: Param::from_tensor(Tensor::from_data(
                TensorData::new(data.sh0.as_flattened().to_vec(), [n, 1, 3]),
                device,
            )),
            sh_rest: (rest > 0).then(|| {
                Param::from_tensor(Tensor::from_data(
                    TensorData::new(data.sh_rest.clone(), [n, rest, 3]),
                    device,
                ))
            }),
            sh_starts: None,
        }
    }

    /// Reads the scene back from the device. Render settings are not part of the model:
    /// [`SplatData::settings`] is empty. Where Gaussians have different degrees, the scene has the
    /// highest that is in use, and zeros beyond that of a Gaussian, as files do.
    pub fn to_data(&self) -> SplatData {
        SplatData {
            origin: self.origin,
            means: rows(self.means.val()),
            log_scales: rows(self.log_scales.val()),
            quats: rows(self.quats.val()),
            opacity_logits: host(self.opacity_logits.val()),
            sh0: rows(self.sh0.val().squeeze_dim(1)),
            sh_rest: self.padded_sh_rest(),
            sh_degree: self.sh_degree(),
            settings: SceneSettings::default(),
        }
    }

    /// Stores the higher degrees with the given precision. Half precision is irreversible and makes
    /// them constants, so a model to be trained stays exact. The model is unchanged if the device's
    /// kernels cannot read half precision (as on all CPUs), or if a coefficient is too large for
    /// it.
    #[must_use]
    pub fn with_sh_precision(mut self, precision: ShPrecision) -> Self {
        if let (ShPrecision::Half, Some(rest)) = (precision, &self.sh_rest) {
            let values = rest.val().set_require_grad(false);
            let fits = || values.clone().abs().max().into_scalar::<f32>() <= HALF_MAX;
            let is_empty = values.shape().num_elements() == 0;
            if reads_half(&values.device()) && !is_empty && fits() {
                self.sh_rest = Some(Param::initialized(rest.id, values.cast(DType::F16)));
            }
        }
        self
    }

    /// Storage precision of the higher degrees.
    pub fn sh_precision(&self) -> ShPrecision {
        match self.sh_rest.as_ref().map(|rest| rest.val().dtype()) {
            Some(DType::F16) => ShPrecision::Half,
            _ => ShPrecision::Exact,
        }
    }

    /// Number of Gaussians, N.
    pub fn len(&self) -> usize {
        self.means.val().dims()[0]
    }

    /// True if there are no Gaussians.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Highest degree of spherical harmonics that the coefficients of a Gaussian can hold.
    pub fn sh_degree(&self) -> usize {
        if let Some(starts) = &self.sh_starts {
            return starts.highest_degree();
        }
        let count = 1 + self.sh_rest.as_ref().map_or(0, |rest| rest.val().dims()[1]);
        (0..=SH_DEGREE_MAX)
            .rev()
            .find(|degree| sh_coefficient_count(*degree) <= count)
            .unwrap_or(0)
    }

    /// Linear scales `[N, 3]`.
    pub fn scales(&self) -> Tensor<2> {
        exp(self.log_scales.val())
    }

    /// Opacities in (0, 1), `[N]`.
    pub fn opacities(&self) -> Tensor<1> {
        sigmoid(self.opacity_logits.val())
    }

    /// Colours `[C, N, 3]` for cameras with the given centres `[C, 3]`, see [`sh_colors`]. If
    /// `seen`, the projection to the same cameras, is given, culled Gaussians are skipped and
    /// black.
    ///
    /// # Errors
    /// When the model lacks coefficients of that degree, or the centres or `seen` do not fit.
    pub fn colors(
        &self,
        centers: Tensor<2>,
        settings: impl Into<ShColorSettings>,
        seen: Option<&Projected>,
    ) -> Result<Tensor<3>, OpError> {
        let sh_rest = self.sh_rest.as_ref().map(|rest| rest.val());
        let sh_rest = match (sh_rest, &self.sh_starts) {
            (Some(coefficients), Some(starts)) => ShRest::Ragged {
                starts: starts.on(&coefficients.device()),
                coefficients,
            },
            (rest, _) => rest.into(),
        };
        sh_colors(
            self.sh0.val(),
            sh_rest,
            self.means.val(),
            centers,
            settings,
            seen,
        )
    }
}

/// Values of a float tensor on the host.
pub(crate) fn host<const R: usize>(tensor: Tensor<R>) -> Vec<f32> {
    tensor
        .into_data()
        .convert::<f32>()
        .try_into_vec()
        .expect("just converted to f32")
}

fn rows<const W: usize>(tensor: Tensor<2>) -> Vec<[f32; W]> {
    host(tensor).as_chunks().0.to_vec()
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;

    fn scene(rest: f32) -> SplatData {
        SplatData {
            means: vec![[0.0; 3]; 3],
            log_scales: vec![[0.0; 3]; 3],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 3],
            opacity_logits: vec![0.0; 3],
            sh0: vec![[0.5; 3]; 3],
            sh_rest: vec![rest; 3 * 9],
            sh_degree: 1,
            ..SplatData::default()
        }
    }

    #[test]
    fn half_precision_is_for_devices_that_read_it_and_for_numbers_that_fit() {
        let mut devices = vec![Device::flex()];
        #[cfg(feature = "wgpu")]
        devices.extend(crate::test_adapter::wgpu());
        let colors = |gaussians: &Gaussians, device: &Device| {
            let colors = gaussians.colors(Tensor::<2>::ones([1, 3], device), 1, None);
            host(colors.unwrap())
        };
        for device in devices {
            let third = scene(1.0 / 3.0);
            let exact = Gaussians::from_data(&third, &device);
            let half = exact.clone().with_sh_precision(ShPrecision::Half);
            let reads = reads_half(&device);
            let expected = [ShPrecision::Exact, ShPrecision::Half][usize::from(reads)];
            assert_eq!(half.sh_precision(), expected, "{device:?}");
            let [a, b] = [&exact, &half].map(|gaussians| colors(gaussians, &device));
            let error = a.iter().zip(&b).map(|(a, b)| (a - b).abs());
            let error = error.fold(0.0, f32::max);
            assert!(
                error < 1e-3 && (error > 0.0) == reads,
                "{device:?}: {error}"
            );
            let kept = half.to_data();
            assert_eq!(kept.sh0, third.sh0);
            let rounded = if reads { 0.333_251_95 } else { 1.0 / 3.0 };
            assert_eq!(kept.sh_rest, vec![rounded; 27], "{device:?}");

            for scene in [scene(65_600.0), SplatData::default()] {
                let kept = Gaussians::from_data(&scene, &device);
                let kept = kept.with_sh_precision(ShPrecision::Half);
                assert_eq!(kept.sh_precision(), ShPrecision::Exact, "{device:?}");
                assert_eq!(kept.to_data(), scene);
            }
            let same = exact.clone().with_sh_precision(ShPrecision::Exact);
            assert_eq!(same.to_data(), third);
        }
    }
}
