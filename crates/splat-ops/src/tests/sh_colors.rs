//! Compares `sh_colors` with the ops it replaces: values and all gradients, in double precision and
//! on every device.

use burn::tensor::{Bool, DType, Device, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::devices;
use crate::backend::{PROJECTED_EXTENT, PROJECTED_WIDTH};
use crate::{
    ClampGradient, ImageSize, Projected, ShColorSettings, sh_coefficient_count, sh_colors,
    spherical_harmonics,
};

/// Inputs as leaves: sh0, sh_rest, means, centres.
struct Leaves {
    sh0: Tensor<3>,
    sh_rest: Tensor<3>,
    means: Tensor<2>,
    centers: Tensor<2>,
}

impl Leaves {
    /// Some colours are far below zero and one is exactly zero. The first mean is at the first
    /// camera's centre. Every third Gaussian is unseen (see [`weights`]), and one of those has NaN
    /// coefficients.
    fn new(c: usize, n: usize, device: &Device, dtype: DType) -> Self {
        let mut rng = Pcg32::seed_from_u64(70);
        let mut values =
            |len: usize| -> Vec<f64> { (0..len).map(|_| rng.random_range(-1.0..1.0)).collect() };
        let mut sh0 = values(n * 3);
        let mut sh_rest = values(n * 15 * 3);
        let (mut means, centers) = (values(n * 3), values(c * 3));
        if n > 4 {
            means[..3].copy_from_slice(&centers[..3]);
            sh0[3..6].fill(-9.0);
            sh_rest[2 * 45..3 * 45].fill(f64::NAN);
            // A dark Gaussian has a channel exactly on the clamp at any degree.
            sh0[3 * 4] = -0.5 / 0.282_094_791_773_878_14;
            for k in 0..15 {
                sh_rest[4 * 45 + 3 * k] = 0.0;
            }
        }
        let data = |values: Vec<f64>, shape: &[usize]| TensorData::new(values, shape.to_vec());
        let options = (device, dtype);
        Self {
            sh0: Tensor::from_data(data(sh0, &[n, 1, 3]), options).require_grad(),
            sh_rest: Tensor::from_data(data(sh_rest, &[n, 15, 3]), options).require_grad(),
            means: Tensor::from_data(data(means, &[n, 3]), options).require_grad(),
            centers: Tensor::from_data(data(centers, &[c, 3]), options).require_grad(),
        }
    }

    fn fused(&self, degree: usize, seen: Option<&Projected>) -> Tensor<3> {
        let [sh0, rest] = [&self.sh0, &self.sh_rest].map(|x| x.clone());
        sh_colors(
            sh0,
            Some(rest),
            self.means.clone(),
            self.centers.clone(),
            degree,
            seen,
        )
        .unwrap()
    }

    fn composed(&self, degree: usize) -> Tensor<3> {
        let [n, _] = self.means.dims();
        let [c, _] = self.centers.dims();
        let coeffs = Tensor::cat(vec![self.sh0.clone(), self.sh_rest.clone()], 1);
        let coeffs = coeffs.narrow(1, 0, sh_coefficient_count(degree));
        let means = self.means.clone().reshape([1, -1, 3]).repeat_dim(0, c);
        let centers = self.centers.clone().reshape([c, 1, 3]).repeat_dim(1, n);
        let colors = spherical_harmonics(coeffs, means - centers, degree).unwrap();
        (colors + 0.5).clamp_min(0.0)
    }

    /// Colours of seen Gaussians, then the gradients that exist.
    fn results(&self, colors: Tensor<3>) -> Vec<(&'static str, Vec<f64>)> {
        let [c, n, _] = colors.dims();
        let mut rng = Pcg32::seed_from_u64(71);
        let weights: Vec<f64> = (0..c * n * 3)
            .map(|i| {
                let weight = rng.random_range(-1.0..1.0);
                if i / 3 % n % 3 == 2 { 0.0 } else { weight }
            })
            .collect();
        let options = (&colors.device(), colors.dtype());
        let weights = Tensor::<3>::from_data(TensorData::new(weights, [c, n, 3]), options);
        let seen = weights.clone().equal_elem(0.0);
        self.values_and_gradients(colors.mask_fill(seen, 0.0), weights)
    }

    /// Colours, then the gradients that exist, from the gradient of the colours.
    fn values_and_gradients(
        &self,
        colors: Tensor<3>,
        weights: Tensor<3>,
    ) -> Vec<(&'static str, Vec<f64>)> {
        let grads = (colors.clone() * weights).sum().backward();
        let to_host = |data: TensorData| data.convert::<f64>().try_into_vec::<f64>().unwrap();
        let mut found = vec![("colors", to_host(colors.into_data()))];
        for (name, leaf) in [("sh0", &self.sh0), ("sh_rest", &self.sh_rest)] {
            found.extend(
                leaf.grad(&grads)
                    .map(|grad| (name, to_host(grad.into_data()))),
            );
        }
        for (name, leaf) in [("means", &self.means), ("centers", &self.centers)] {
            found.extend(
                leaf.grad(&grads)
                    .map(|grad| (name, to_host(grad.into_data()))),
            );
        }
        found
    }
}

fn relative(a: &[f64], b: &[f64]) -> f64 {
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|x| x * x).sum::<f64>().sqrt();
    let difference = norm(&mut a.iter().zip(b).map(|(a, b)| a - b));
    difference / norm(&mut b.iter().copied()).max(f64::MIN_POSITIVE)
}

#[test]
fn colors_and_gradients_are_those_of_the_composed_ops() {
    let mut cases: Vec<_> = devices()
        .into_iter()
        .map(|(name, device)| (name, device, DType::F32, 1e-5))
        .collect();
    cases.push(("Flex f64", Device::flex(), DType::F64, 1e-12));
    for (name, device, dtype, bound) in cases {
        let device = device.autodiff();
        for (c, n, degree) in [
            (1, 7, 0),
            (1, 700, 1),
            (2, 65, 2),
            (1, 700, 3),
            (3, 33, 3),
            (2, 2500, 3),
        ] {
            let case = format!("{name}: C = {c}, N = {n}, degree {degree}");
            let leaves = Leaves::new(c, n, &device, dtype);
            let fused = leaves.results(leaves.fused(degree, None));
            let composed = leaves.results(leaves.composed(degree));
            // At degree 0 directions and higher coefficients are not part of the graph.
            assert_eq!(fused.len(), if degree == 0 { 2 } else { 5 }, "{case}");
            for (part, fused) in &fused {
                let (_, composed) = composed.iter().find(|(name, _)| name == part).unwrap();
                assert!(composed.iter().any(|x| *x != 0.0), "{case}: {part}");
                let error = relative(fused, composed);
                assert!(error <= bound, "{case}: {part} differs by {error:e}");
            }
        }
    }
}

/// Everything else matches the result without `seen`, bit for bit; gradients that later ops give to
/// culled Gaussians must not arrive.
#[test]
fn what_a_camera_culled_is_black_and_gets_no_gradient() {
    let mut cases: Vec<_> = devices()
        .into_iter()
        .map(|(name, device)| (name, device, DType::F32))
        .collect();
    cases.push(("Flex f64", Device::flex(), DType::F64));
    for (name, device, dtype) in cases {
        let device = device.autodiff();
        for (c, n, degree) in [(1, 700, 3), (2, 65, 0), (3, 33, 2), (1, 1100, 1)] {
            let leaves = Leaves::new(c, n, &device, dtype);
            // The third Gaussian, with NaN coefficients, is unseen; the last chunk ends with unseen
            // ones.
            let is_seen = |camera: usize, gaussian: usize| {
                gaussian % 3 != 2 && !(gaussian + camera).is_multiple_of(5) && gaussian + 4 < n
            };
            let mut packed = vec![0.0; c * n * PROJECTED_WIDTH];
            let mut culled = vec![false; c * n * 3];
            for index in 0..c * n {
                if is_seen(index / n, index % n) {
                    packed[index * PROJECTED_WIDTH + PROJECTED_EXTENT] = 0.5;
                } else {
                    culled[3 * index..3 * index + 3].fill(true);
                }
            }
            let packed = TensorData::new(packed, [c, n, PROJECTED_WIDTH]);
            let packed = Tensor::<3>::from_data(packed, (&device, dtype)).require_grad();
            let size = ImageSize {
                width: 8,
                height: 8,
            };
            let seen = Projected::from_packed(packed, size).unwrap();
            let culled = TensorData::new(culled, [c, n, 3]);
            let culled = Tensor::<3, Bool>::from_data(culled, &device);

            let weights = Tensor::<3>::ones([c, n, 3], (&device, dtype)) * 0.75;
            let found = leaves.fused(degree, Some(&seen));
            let found = leaves.values_and_gradients(found, weights.clone());
            let masked = leaves.fused(degree, None).mask_fill(culled, 0.0);
            let expected = leaves.values_and_gradients(masked, weights);
            assert_eq!(found.len(), if degree == 0 { 2 } else { 5 }, "{name}");
            for (found, expected) in found.iter().zip(&expected) {
                let part = found.0;
                assert!(found == expected, "{name}, degree {degree}: {part}");
                assert!(found.1.iter().any(|x| *x != 0.0), "{name}: {part}");
            }
        }
    }
}

/// Below zero the exact gradient is zero; the recovering one passes what would raise the channel
/// under descent. Without clamping both are equal.
#[test]
fn a_channel_below_zero_can_recover_if_asked_to() {
    const Y0: f32 = splat_core::SH_C0 as f32;
    let below = -2.0f32;
    for (name, device) in devices() {
        let device = device.autodiff();
        let tensor = |values: [f32; 6], shape: [usize; 3]| {
            Tensor::<3>::from_data(TensorData::new(values.to_vec(), shape), &device)
        };
        let slopes = |clamp_gradient: ClampGradient| -> Vec<f32> {
            let sh0 = tensor([below, below, 1.0, below, 1.0, below], [2, 1, 3]).require_grad();
            let upstream = tensor([0.5, -0.5, 0.5, -0.25, -0.5, 0.0], [1, 2, 3]);
            let [means, centers] = [2, 1].map(|rows| Tensor::<2>::ones([rows, 3], &device));
            let settings = ShColorSettings {
                degree: 0,
                clamp_gradient,
            };
            let colors = sh_colors(sh0.clone(), None, means, centers, settings, None).unwrap();
            let grads = (colors * upstream).sum().backward();
            let slopes = sh0.grad(&grads).unwrap().into_data();
            let slopes = slopes.try_into_vec::<f32>().unwrap();
            slopes
                .iter()
                .map(|slope| (slope / Y0 * 1e4).round() / 1e4)
                .collect()
        };
        let exact = slopes(ClampGradient::Exact);
        assert_eq!(exact, [0.0, 0.0, 0.5, 0.0, -0.5, 0.0], "{name}");
        let recovering = slopes(ClampGradient::Recovering);
        assert_eq!(recovering, [0.0, -0.5, 0.5, -0.25, -0.5, 0.0], "{name}");
    }
}

/// A Gaussian with a broken coefficient must look broken, not black.
#[test]
fn what_is_not_a_number_is_not_clamped() {
    for (name, device) in devices() {
        let sh0 = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -9.0, -0.0, 9.0];
        let sh0 = Tensor::<3>::from_data(TensorData::new(sh0.to_vec(), [2, 1, 3]), &device);
        let [means, centers] = [2, 1].map(|rows| Tensor::<2>::ones([rows, 3], &device));
        let colors = sh_colors(sh0, None, means, centers, 0, None).unwrap();
        let colors = colors.into_data().try_into_vec::<f32>().unwrap();
        assert!(colors[0].is_nan(), "{name}: {colors:?}");
        assert_eq!(colors[1..5], [f32::INFINITY, 0.0, 0.0, 0.5], "{name}");
        assert!(colors[5] > 3.0, "{name}: {colors:?}");
    }
}

#[test]
fn what_does_not_fit_is_an_error() {
    let device = Device::flex().autodiff();
    let leaves = Leaves::new(1, 6, &device, DType::F32);
    let refuse = |rest: Option<Tensor<3>>, centers: Tensor<2>, degree: usize| {
        sh_colors(
            leaves.sh0.clone(),
            rest,
            leaves.means.clone(),
            centers,
            degree,
            None,
        )
        .unwrap_err()
    };
    let size = ImageSize {
        width: 8,
        height: 8,
    };
    let other = Tensor::zeros([1, 7, PROJECTED_WIDTH], &device);
    let other = Projected::from_packed(other, size).unwrap();
    let error = sh_colors(
        leaves.sh0.clone(),
        None,
        leaves.means.clone(),
        leaves.centers.clone(),
        0,
        Some(&other),
    )
    .unwrap_err();
    assert!(error.to_string().contains("`seen`"), "{error}");
    let rest = |count: usize| Some(leaves.sh_rest.clone().narrow(1, 0, count));
    for error in [
        refuse(None, leaves.centers.clone(), 1),
        refuse(rest(14), leaves.centers.clone(), 3),
        refuse(rest(15), leaves.centers.clone(), 4),
        refuse(rest(15), Tensor::zeros([1, 4], &device), 1),
        refuse(
            rest(15).map(|rest| rest.cast(DType::F16)),
            leaves.centers.clone(),
            3,
        ),
        refuse(
            rest(15).map(|rest| rest.cast(DType::F64)),
            leaves.centers.clone(),
            3,
        ),
    ] {
        assert!(error.to_string().contains("sh_colors"), "{error}");
    }
}

/// Colours and gradients with higher degrees in half precision, and exact ones, against double
/// precision of the unrounded coefficients. The colours are bright, as the gradient has a step at
/// the clamp.
#[test]
fn half_precision_costs_so_much() {
    let (c, n) = (2, 2500);
    let mut leaves = Leaves::new(c, n, &Device::flex().autodiff(), DType::F64);
    leaves.sh0 = (leaves.sh0.set_require_grad(false).clamp_min(-1.0) + 6.0).require_grad();
    leaves.sh_rest = (leaves.sh_rest.set_require_grad(false) * 0.25).require_grad();
    let expected = leaves.results(leaves.fused(3, None));
    for (name, device) in devices() {
        let device = device.autodiff();
        for (stored, bounds) in [(DType::F32, [1e-6, 1e-5]), (DType::F16, [1e-4, 4e-4])] {
            let constant = |tensor: &Tensor<3>, dtype: DType| {
                let data = tensor.clone().into_data();
                Tensor::<3>::from_data(data, (&device, dtype))
            };
            let leaf = |tensor: &Tensor<2>| {
                let data = tensor.clone().into_data();
                Tensor::<2>::from_data(data, (&device, DType::F32)).require_grad()
            };
            let ours = Leaves {
                sh0: constant(&leaves.sh0, DType::F32).require_grad(),
                sh_rest: constant(&leaves.sh_rest, stored),
                means: leaf(&leaves.means),
                centers: leaf(&leaves.centers),
            };
            let found = ours.results(ours.fused(3, None));
            for (part, found) in &found {
                let (_, expected) = expected.iter().find(|(name, _)| name == part).unwrap();
                let error = relative(found, expected);
                println!("{name}, rest as {stored:?}: {part} {error:.1e}");
                let bound = bounds[usize::from(*part != "colors")];
                assert!(error <= bound, "{name}, {stored:?}: {part} {error:e}");
                // Checks that halves were read at all.
                let read = stored == DType::F16 && *part == "colors";
                assert!(!read || error > 5e-6, "{name}: {error:e}");
            }
            assert_eq!(found.len(), 4);
        }
    }
}
