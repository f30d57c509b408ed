//! Time against error of the projection, by camera model.

use std::time::Instant;

use burn::tensor::{DType, Device, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::Serialize;
use splat_ops::{Distortion, ImageSize, Intrinsics, Lens, ProjectSettings, project};

use super::measure::AccuracyError;
use crate::gradcheck::relative_l2;

const SIZE: ImageSize = ImageSize {
    width: 640,
    height: 480,
};
/// Gaussians per call.
const COUNT: usize = 100_000;
/// Runs whose fastest counts.
const RUNS: usize = 5;

/// The lenses, by name, with the focal length that shows all of the image in their domain.
const LENSES: [(&str, Lens, f64); 5] = [
    ("pinhole", Lens::Pinhole, 500.0),
    (
        "opencv, mild",
        Lens::OpenCv([-0.1, 0.02, 1e-3, -1e-3, 0.0, 0.0, 0.0, 0.0]),
        500.0,
    ),
    (
        "opencv, strong",
        Lens::OpenCv([0.4, 0.1, -1e-3, 2e-3, 0.05, 0.1, 0.0, 0.0]),
        400.0,
    ),
    (
        "opencv_fisheye, mild",
        Lens::OpenCvFisheye([-0.02, 0.003, 0.0, 0.0]),
        400.0,
    ),
    (
        "opencv_fisheye, to 115 degrees",
        Lens::OpenCvFisheye([-0.01, 0.002, 0.0, 0.0]),
        200.0,
    ),
];

/// Time and error of one camera model on one backend.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LensRow {
    /// The lens.
    pub name: &'static str,
    /// Backend.
    pub backend: String,
    /// Nanoseconds per Gaussian, forward; without camera gradients backward; with them.
    pub nanoseconds: [f64; 3],
    /// Relative L2 error of screen means and inverse Cholesky factors, single precision against
    /// double.
    pub forward: f64,
    /// The worst of the gradients of means, rotations, scales, poses, intrinsics, coefficients.
    pub gradient: f64,
    /// Name of that.
    pub worst_group: &'static str,
}

/// Measures all camera models on a backend.
///
/// # Errors
/// When the op refuses its input or results cannot be read back.
pub fn lens_rows(backend: &str, device: &Device) -> Result<Vec<LensRow>, AccuracyError> {
    let rows = LENSES.iter().map(|(name, lens, focal)| {
        let scene = Scene::random(*lens, *focal);
        let single = scene.run(device, DType::F32, true)?;
        let double = scene.run(&Device::flex(), DType::F64, true)?;
        let errors = single.groups.iter().zip(&double.groups);
        let errors = errors.map(|((name, ours), (_, exact))| (relative_l2(ours, exact), *name));
        let (gradient, worst_group) = errors
            .max_by(|a, b| a.0.total_cmp(&b.0))
            .unwrap_or((f64::NAN, ""));
        let mut fastest = [single.seconds[0], f64::INFINITY, single.seconds[1]];
        for _ in 0..RUNS {
            let plain = scene.run(device, DType::F32, false)?;
            let cameras = scene.run(device, DType::F32, true)?;
            let seconds = [plain.seconds[0], plain.seconds[1], cameras.seconds[1]];
            for (fastest, seconds) in fastest.iter_mut().zip(seconds) {
                *fastest = fastest.min(seconds);
            }
        }
        Ok(LensRow {
            name,
            backend: backend.to_owned(),
            nanoseconds: fastest.map(|seconds| 1e9 * seconds / COUNT as f64),
            forward: relative_l2(&single.packed, &double.packed),
            gradient,
            worst_group,
        })
    });
    rows.collect()
}

/// Gaussians all over the image of a lens, rounded to single precision.
struct Scene {
    lens: Lens,
    intrinsics: [f64; 4],
    means: Vec<f32>,
    quats: Vec<f32>,
    scales: Vec<f32>,
}

/// Results of a run.
struct Run {
    /// Of the forward and of the backward pass.
    seconds: [f64; 2],
    /// Columns 0, 1, 3, 4, 5 of the packed splats.
    packed: Vec<f64>,
    /// Gradients by name.
    groups: Vec<(&'static str, Vec<f64>)>,
}

impl Scene {
    fn random(lens: Lens, focal: f64) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(11);
        let (w, h) = (f64::from(SIZE.width), f64::from(SIZE.height));
        let intrinsics = [focal, focal, w / 2.0, h / 2.0];
        let bounded = lens.bounded();
        let mut scene = Self {
            lens,
            intrinsics,
            means: Vec::with_capacity(3 * COUNT),
            quats: Vec::with_capacity(4 * COUNT),
            scales: Vec::with_capacity(3 * COUNT),
        };
        while scene.means.len() < 3 * COUNT {
            let at = |rng: &mut Pcg64Mcg, side: f64| {
                (rng.random_range(0.02..0.98) * side - side / 2.0) / focal
            };
            let point = [at(&mut rng, w), at(&mut rng, h)];
            let Some(direction) = bounded.undistort(point) else {
                continue;
            };
            let depth = rng.random_range(2.0..6.0);
            scene.means.extend(direction.map(|x| (x * depth) as f32));
            scene
                .quats
                .extend((0..4).map(|_| rng.random_range(-1.0f32..1.0)));
            let axis = |rng: &mut Pcg64Mcg| (rng.random_range(1.0..4.0) * depth / focal) as f32;
            scene.scales.extend((0..3).map(|_| axis(&mut rng)));
        }
        scene
    }

    fn run(&self, device: &Device, dtype: DType, cameras: bool) -> Result<Run, AccuracyError> {
        let device = device.clone().without_autodiff().autodiff();
        let constant = |values: &[f32], width: usize| {
            let shape = [values.len() / width, width];
            let data = TensorData::new(values.to_vec(), shape);
            Tensor::<2>::from_data(data, (&device, dtype))
        };
        let row = |values: &[f64]| {
            let values: Vec<f32> = values.iter().map(|value| *value as f32).collect();
            constant(&values, values.len())
        };
        let of_camera = |tensor: Tensor<2>| match cameras {
            true => tensor.require_grad(),
            false => tensor,
        };
        let means = constant(&self.means, 3).require_grad();
        let quats = constant(&self.quats, 4).require_grad();
        let scales = constant(&self.scales, 3).require_grad();
        let viewmats = of_camera(Tensor::<2>::eye(4, &device).cast(dtype));
        let pinhole = of_camera(row(&self.intrinsics));
        let k = self.lens.coefficients();
        let coefficients = (!k.is_empty()).then(|| of_camera(row(k)));
        let distortion = coefficients.clone().map(|coefficients| {
            let domain = self.lens.domain(self.intrinsics, SIZE);
            Distortion {
                model: self.lens.model(),
                coefficients,
                domain: row(&[domain.limit, domain.clamp]),
            }
        });
        let intrinsics = Intrinsics {
            pinhole: pinhole.clone(),
            distortion,
        };
        // Upstream gradients of a size that screen means and factors share.
        let mut rng = Pcg64Mcg::seed_from_u64(13);
        let upstream: Vec<f32> = (0..COUNT)
            .flat_map(|_| [1.0, 1.0, 0.1, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
            .map(|size: f32| size * rng.random_range(-1.0..1.0))
            .collect();
        let upstream = constant(&upstream, 9).unsqueeze::<3>();
        // Everything is there before the clock starts.
        read(&upstream.clone().narrow(1, 0, 1))?;

        let start = Instant::now();
        let projected = project(
            means.clone(),
            quats.clone(),
            scales.clone(),
            viewmats.clone().unsqueeze(),
            intrinsics,
            SIZE,
            &ProjectSettings::default(),
        )?;
        let packed = projected.packed();
        read(&packed.clone().narrow(1, COUNT - 1, 1))?;
        let forward = start.elapsed().as_secs_f64();
        let loss = (packed.clone() * upstream).sum();
        read(&loss)?;
        let start = Instant::now();
        let gradients = loss.backward();
        let leaves = [
            ("means", Some(means)),
            ("quats", Some(quats)),
            ("scales", Some(scales)),
            ("viewmats", Some(viewmats)),
            ("intrinsics", Some(pinhole)),
            ("coefficients", coefficients),
        ];
        let found = leaves.into_iter().filter_map(|(name, leaf)| {
            let gradient = leaf.filter(Tensor::is_require_grad)?.grad(&gradients)?;
            Some((name, gradient))
        });
        let found: Vec<_> = found.collect();
        for (_, gradient) in &found {
            read(&gradient.clone().narrow(0, 0, 1))?;
        }
        let seconds = [forward, start.elapsed().as_secs_f64()];
        let columns = [(0, 2), (3, 3)].map(|(first, count)| packed.clone().narrow(2, first, count));
        let packed = [read(&columns[0])?, read(&columns[1])?].concat();
        let groups = found
            .into_iter()
            .map(|(name, gradient)| Ok((name, read(&gradient)?)));
        Ok(Run {
            seconds,
            packed,
            groups: groups.collect::<Result<_, AccuracyError>>()?,
        })
    }
}

fn read<const R: usize>(tensor: &Tensor<R>) -> Result<Vec<f64>, AccuracyError> {
    let values = tensor.clone().try_into_vec_as::<f64>();
    values.map_err(|error| AccuracyError::Read(error.to_string()))
}
