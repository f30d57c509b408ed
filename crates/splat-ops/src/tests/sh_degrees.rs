//! Gaussians of different degrees have the colours and gradients of Gaussians of the highest one
//! with zeros in place, on every device and in double precision.

use burn::tensor::{DType, Device, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::devices;
use crate::backend::{PROJECTED_EXTENT, PROJECTED_WIDTH};
use crate::{
    ClampGradient, ImageSize, OpError, Projected, ShColorSettings, ShRest, ShStarts,
    sh_coefficient_count, sh_colors,
};

/// Values of a scene of N Gaussians and C cameras.
struct Scene {
    sh0: Vec<f64>,
    /// `[N, 15, 3]`, zero beyond a Gaussian's degree.
    rest: Vec<f64>,
    means: Vec<f64>,
    centers: Vec<f64>,
    degrees: Vec<usize>,
    /// Gradient of the colours; some are zero.
    weights: Vec<f64>,
    /// Packed splats, some of them culled.
    packed: Vec<f64>,
}

/// Colours, then gradients of sh0, the coefficients, means and centres.
type Results = [Vec<f64>; 5];

impl Scene {
    fn new(c: usize, degrees: Vec<usize>) -> Self {
        let n = degrees.len();
        let mut rng = Pcg32::seed_from_u64(72);
        let mut values =
            |len: usize| -> Vec<f64> { (0..len).map(|_| rng.random_range(-1.0..1.0)).collect() };
        let mut scene = Self {
            sh0: values(3 * n),
            rest: values(45 * n),
            means: values(3 * n),
            centers: values(3 * c),
            weights: values(3 * c * n),
            packed: vec![0.0; c * n * PROJECTED_WIDTH],
            degrees,
        };
        for (rest, degree) in scene.rest.chunks_mut(45).zip(&scene.degrees) {
            rest[3 * (sh_coefficient_count(*degree) - 1)..].fill(0.0);
        }
        for index in 0..c * n {
            if index % 7 != 3 {
                scene.packed[index * PROJECTED_WIDTH + PROJECTED_EXTENT] = 0.5;
            }
            if index % 5 == 2 {
                scene.weights[3 * index..3 * index + 3].fill(0.0);
            }
        }
        scene
    }

    /// The coefficients that the Gaussians have.
    fn own<'a>(&'a self, rest: &'a [f64]) -> impl Iterator<Item = f64> + 'a {
        let of_each = rest.chunks(45).zip(&self.degrees);
        of_each.flat_map(|(rest, degree)| {
            let count = 3 * (sh_coefficient_count(*degree) - 1);
            rest[..count].iter().copied()
        })
    }

    fn run(&self, device: &Device, dtype: DType, degree: usize, ragged: bool) -> Results {
        let (n, c) = (self.degrees.len(), self.centers.len() / 3);
        let options = (device, dtype);
        let two = |values: &[f64]| {
            let shape = [values.len() / 3, 3];
            let tensor = Tensor::<2>::from_data(TensorData::new(values.to_vec(), shape), options);
            tensor.require_grad()
        };
        let three = |values: Vec<f64>, shape: [usize; 3]| {
            Tensor::<3>::from_data(TensorData::new(values, shape), options)
        };
        let sh0 = three(self.sh0.clone(), [n, 1, 3]).require_grad();
        let (means, centers) = (two(&self.means), two(&self.centers));
        let rest = match ragged {
            false => three(self.rest.clone(), [n, 15, 3]),
            true => {
                let own: Vec<f64> = self.own(&self.rest).collect();
                let rows = own.len() / 3;
                three(own, [rows, 1, 3])
            }
        };
        let rest = rest.require_grad();
        let starts = ShStarts::of_degrees(self.degrees.iter().copied(), device).unwrap();
        let sh_rest = match ragged {
            false => ShRest::Uniform(rest.clone()),
            true => ShRest::Ragged {
                coefficients: rest.clone(),
                starts,
            },
        };
        let size = ImageSize {
            width: 8,
            height: 8,
        };
        let packed = three(self.packed.clone(), [c, n, PROJECTED_WIDTH]);
        let seen = Projected::from_packed(packed, size).unwrap();
        let settings = ShColorSettings {
            degree,
            clamp_gradient: ClampGradient::Recovering,
        };
        let colors = sh_colors(
            sh0.clone(),
            sh_rest,
            means.clone(),
            centers.clone(),
            settings,
            Some(&seen),
        )
        .unwrap();
        let weights = three(self.weights.clone(), [c, n, 3]);
        let gradients = (colors.clone() * weights).sum().backward();
        let host = |data: TensorData| data.convert::<f64>().try_into_vec::<f64>().unwrap();
        let of_three = |leaf: &Tensor<3>| leaf.grad(&gradients).map(|grad| host(grad.into_data()));
        let of_two = |leaf: &Tensor<2>| leaf.grad(&gradients).map(|grad| host(grad.into_data()));
        let of_rest = of_three(&rest).unwrap_or_default();
        [
            host(colors.into_data()),
            of_three(&sh0).unwrap(),
            match ragged {
                true => of_rest,
                false => self.own(&of_rest).collect(),
            },
            of_two(&means).unwrap_or_default(),
            of_two(&centers).unwrap_or_default(),
        ]
    }
}

/// Devices and precisions, with the rounding of a sum in another order.
fn cases() -> Vec<(&'static str, Device, DType, f64)> {
    let mut cases: Vec<_> = devices()
        .into_iter()
        .map(|(name, device)| (name, device.autodiff(), DType::F32, 1e-5))
        .collect();
    cases.push(("Flex f64", Device::flex().autodiff(), DType::F64, 1e-13));
    cases
}

const PARTS: [&str; 5] = ["colours", "sh0", "rest", "means", "centres"];

#[test]
fn gaussians_all_of_degree_three_are_as_ever_bit_for_bit() {
    for (name, device, dtype, _) in cases() {
        let scene = Scene::new(2, vec![3; 1300]);
        for degree in 1..=3 {
            let [ragged, uniform] =
                [true, false].map(|ragged| scene.run(&device, dtype, degree, ragged));
            for (part, (ragged, uniform)) in PARTS.iter().zip(ragged.iter().zip(&uniform)) {
                assert!(ragged == uniform, "{name}, degree {degree}: {part}");
                assert!(uniform.iter().any(|x| *x != 0.0), "{name}: {part}");
            }
        }
    }
}

#[test]
fn gaussians_of_a_lower_degree_are_as_with_zeros_in_place() {
    for (name, device, dtype, rounding) in cases() {
        // A long stretch of degree 0, so that a whole chunk has no coefficients.
        let degree = |i: usize| {
            if (600..1800).contains(&i) {
                0
            } else {
                i % 11 % 4
            }
        };
        for (c, n) in [(1, 2500), (3, 70), (2, 1)] {
            let mut degrees: Vec<usize> = (0..n).map(degree).collect();
            degrees[n - 1] = 2;
            let scene = Scene::new(c, degrees);
            for degree in 1..=3 {
                let [ragged, uniform] =
                    [true, false].map(|ragged| scene.run(&device, dtype, degree, ragged));
                for (part, (ragged, uniform)) in PARTS.iter().zip(ragged.iter().zip(&uniform)) {
                    let case = format!("{name}, C = {c}, N = {n}, degree {degree}: {part}");
                    // On the CPU, the sum over Gaussians is over those of one degree at a time.
                    if *part == "centres" {
                        let norm = uniform.iter().map(|x| x.abs()).fold(0.0, f64::max);
                        let pairs = ragged.iter().zip(uniform);
                        let error = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                        assert!(error <= rounding * norm, "{case}: {error:e} of {norm:e}");
                    } else {
                        assert!(ragged == uniform, "{case}");
                    }
                }
            }
        }
    }
}

/// Where no Gaussian has a coefficient, nothing depends on the direction.
#[test]
fn gaussians_all_of_degree_zero_have_no_coefficients() {
    for (name, device, dtype, _) in cases() {
        let scene = Scene::new(2, vec![0; 40]);
        let [colors, sh0, rest, means, centers] = scene.run(&device, dtype, 3, true);
        let [expected, expected_sh0, ..] = scene.run(&device, dtype, 3, false);
        assert!(colors == expected && sh0 == expected_sh0, "{name}");
        assert!(rest.is_empty() && means.is_empty() && centers.is_empty());
    }
}

#[test]
fn coefficients_that_do_not_fit_their_starts_are_refused() {
    let device = Device::flex();
    let refused = |degrees: &[usize], shape: [usize; 3]| -> OpError {
        let sh_rest = ShRest::Ragged {
            coefficients: Tensor::zeros(shape, &device),
            starts: ShStarts::of_degrees(degrees.iter().copied(), &device).unwrap(),
        };
        let means = Tensor::zeros([2, 3], &device);
        let (sh0, centers) = (
            Tensor::zeros([2, 1, 3], &device),
            Tensor::zeros([1, 3], &device),
        );
        sh_colors(sh0, sh_rest, means, centers, 3, None).unwrap_err()
    };
    for (degrees, shape, word) in [
        (&[1, 2][..], [10, 1, 3], "`sh_rest`"),
        (&[1, 2], [11, 3, 3], "`sh_rest`"),
        (&[1, 2, 0], [11, 1, 3], "`starts`"),
    ] {
        let message = refused(degrees, shape).to_string();
        assert!(message.contains(word), "{message}");
    }
}
