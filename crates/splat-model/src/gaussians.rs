//! The model: a set of 3D Gaussians as a Burn module (3DGS section 4).

use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor, TensorData, activation};
use splat_ops::{SH_DEGREE_MAX, sh_coefficient_count};

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
        self.log_scales.val().exp()
    }

    /// Opacities in (0, 1), `[N]`.
    pub fn opacities(&self) -> Tensor<1> {
        sigmoid(self.opacity_logits.val())
    }

    /// Coefficients `[N, (degree + 1)^2, 3]`, up to a degree that the model has.
    pub fn sh_coefficients(&self, degree: usize) -> Tensor<3> {
        let count = sh_coefficient_count(degree) - 1;
        match &self.sh_rest {
            Some(rest) if count > 0 => {
                let mut rest = rest.val();
                // All of them: no slice, whose gradient would be padded with zeros.
                if count < rest.dims()[1] {
                    rest = rest.narrow(1, 0, count);
                }
                Tensor::cat(vec![self.sh0.val(), rest], 1)
            }
            _ => self.sh0.val(),
        }
    }
}

/// The logistic function as `exp(min(x, 0)) / (1 + exp(-|x|))`. Burn's own differentiates it as `o (1 - o)`, which is
/// exactly zero once o rounds to one (from a logit of 17 on in single precision): a Gaussian could never become
/// transparent again. Differentiated term by term this form keeps every digit at both ends. The two halves of x split
/// so that exactly one of them has a derivative, at zero too.
fn sigmoid(x: Tensor<1>) -> Tensor<1> {
    let negative = x.clone().clamp_max(0.0);
    let positive = activation::relu(x);
    let small = (negative.clone() - positive).exp();
    negative.exp() / small.add_scalar(1.0)
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

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;

    /// At both ends, at the bend, and between: opacity and its gradient to a few ulp of `1 / (1 + exp(-x))` in double
    /// precision. Below a logit of -87 the opacity itself leaves the range of normal floats.
    #[test]
    fn opacities_and_their_gradients_keep_their_digits() {
        let logits = [-80.0, -30.0, -5.0, -0.1, 0.0, 0.1, 5.0, 17.0, 30.0, 80.0f32];
        let device = Device::flex().autodiff();
        let x = Tensor::<1>::from_data(TensorData::from(logits), &device).require_grad();
        let opacities = sigmoid(x.clone());
        let gradient = x.grad(&opacities.clone().sum().backward()).unwrap();
        let (opacities, gradient) = (host(opacities), host(gradient));
        for (i, x) in logits.into_iter().map(f64::from).enumerate() {
            let opacity = 1.0 / (1.0 + (-x).exp());
            let slope = 1.0 / ((1.0 + (-x).exp()) * (1.0 + x.exp()));
            let error = |got: f32, want: f64| (f64::from(got) / want - 1.0).abs();
            assert!(error(opacities[i], opacity) < 1e-6, "opacity at {x}");
            assert!(error(gradient[i], slope) < 1e-6, "gradient at {x}");
        }
    }
}
