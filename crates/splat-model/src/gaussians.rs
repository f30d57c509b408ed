//! The model: a set of 3D Gaussians as a Burn module (3DGS section 4).

use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor, TensorData};
use splat_ops::{OpError, SH_DEGREE_MAX, exp, sh_coefficient_count, sh_colors, sigmoid};

use crate::files::SplatData;

/// N Gaussians. Parameters are stored before their activation, as in 3DGS: scales as logarithms,
/// opacities as logits.
#[derive(Module, Debug)]
pub struct Gaussians {
    /// Where in the world the means count from, see [`SplatData::origin`]. Cameras that look at the model must count
    /// from there too: [`Camera::relative_to`](crate::Camera::relative_to).
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
    /// Spherical harmonics of the higher degrees, `[N, (degree + 1)^2 - 1, 3]`; absent for degree 0.
    pub sh_rest: Option<Param<Tensor<3>>>,
}

impl Gaussians {
    /// None at all.
    pub fn empty(device: &Device) -> Self {
        Self::from_data(&SplatData::default(), device)
    }

    /// Puts the values of a scene on a device.
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
        }
    }

    /// Reads the values back from the device.
    pub fn to_data(&self) -> SplatData {
        SplatData {
            origin: self.origin,
            means: rows(self.means.val()),
            log_scales: rows(self.log_scales.val()),
            quats: rows(self.quats.val()),
            opacity_logits: host(self.opacity_logits.val()),
            sh0: rows(self.sh0.val().squeeze_dim(1)),
            sh_rest: self
                .sh_rest
                .as_ref()
                .map_or_else(Vec::new, |rest| host(rest.val())),
            sh_degree: self.sh_degree(),
        }
    }

    /// N.
    pub fn len(&self) -> usize {
        self.means.val().dims()[0]
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Highest degree of spherical harmonics that the coefficients can hold.
    pub fn sh_degree(&self) -> usize {
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

    /// Colours `[C, N, 3]` as cameras with the given centres `[C, 3]` see them, with spherical harmonics up to `degree`.
    ///
    /// # Errors
    /// When the model has no coefficients of that degree, or the centres do not fit.
    pub fn colors(&self, centers: Tensor<2>, degree: usize) -> Result<Tensor<3>, OpError> {
        sh_colors(
            self.sh0.val(),
            self.sh_rest.as_ref().map(|rest| rest.val()),
            self.means.val(),
            centers,
            degree,
        )
    }
}

/// A float tensor's values on the host.
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
