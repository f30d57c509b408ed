//! Accuracy of the projection of random extreme Gaussians in single precision.

use burn::tensor::{DType, Device, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::Serialize;
use splat_ops::{ImageSize, ProjectSettings, project};

use super::measure::AccuracyError;

const SIZE: ImageSize = ImageSize {
    width: 256,
    height: 256,
};
/// fx = fy, cx = cy.
const INTRINSICS: [f64; 4] = [256.0, 256.0, 128.0, 128.0];
/// Gaussians per call.
const BATCH: usize = 100_000;
/// Relative distance to the edge of the view within which rounding may decide.
const EDGE: f64 = 1e-4;

/// Errors of the projection of random extreme Gaussians.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct ProjectionErrors {
    /// Gaussians tested: axes of 1e-4 to 1e4 pixels, up to 1e4 : 1, in every direction, with
    /// quaternions of any length.
    pub gaussians: usize,
    /// Those visible in double precision.
    pub visible: usize,
    /// Visible ones, not at the very edge of the view, that single precision culls.
    pub culled_but_visible: usize,
    /// Largest relative error of the determinant of the screen covariance.
    pub determinant: f64,
    /// Largest error of the exponent at a pixel within the splat's reach.
    pub exponent: f64,
}

/// Projects `gaussians` random extreme Gaussians in single precision on `device` and in double
/// precision on the CPU.
///
/// # Errors
/// When the op refuses its input or results cannot be read back.
pub fn projection_errors(
    gaussians: usize,
    seed: u64,
    device: &Device,
) -> Result<ProjectionErrors, AccuracyError> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut errors = ProjectionErrors::default();
    while errors.gaussians < gaussians {
        let count = BATCH.min(gaussians - errors.gaussians);
        let batch = Batch::random(count, &mut rng);
        let single = batch.project(device, DType::F32)?;
        let double = batch.project(&Device::flex(), DType::F64)?;
        errors.gaussians += count;
        for (ours, exact) in single.chunks(9).zip(double.chunks(9)) {
            errors.compare(ours, exact, &mut rng);
        }
    }
    Ok(errors)
}

impl ProjectionErrors {
    fn compare(&mut self, ours: &[f64], exact: &[f64], rng: &mut Pcg64Mcg) {
        if exact[7] <= 0.0 {
            return;
        }
        self.visible += 1;
        if ours[7] <= 0.0 {
            self.culled_but_visible += usize::from(!at_the_edge(exact));
            return;
        }
        let determinant = |row: &[f64]| (row[3] * row[5]).powi(-2);
        let error = (determinant(ours) / determinant(exact) - 1.0).abs();
        self.determinant = self.determinant.max(error);
        for _ in 0..4 {
            if let Some(pixel) = on_the_splat(exact, rng) {
                let error = (exponent(ours, pixel) - exponent(exact, pixel)).abs();
                self.exponent = self.exponent.max(error);
            }
        }
    }
}

/// True if the bounding box barely touches the image.
fn at_the_edge(row: &[f64]) -> bool {
    let sides = [f64::from(SIZE.width), f64::from(SIZE.height)];
    (0..2).any(|axis| {
        let (mean, extent) = (row[axis], row[7 + axis]);
        let slack = EDGE * (mean.abs() + extent + 1.0);
        mean + extent < slack || mean - extent > sides[axis] - slack
    })
}

fn exponent(row: &[f64], [x, y]: [f64; 2]) -> f64 {
    let (dx, dy) = (x - row[0], y - row[1]);
    let (z1, z2) = (row[3] * dx, row[4] * dx + row[5] * dy);
    (z1 * z1 + z2 * z2) / 2.0
}

/// A random point in the image where the splat's falloff exceeds 1/255: on its ridge, displaced
/// across it.
fn on_the_splat(row: &[f64], rng: &mut Pcg64Mcg) -> Option<[f64; 2]> {
    let x: f64 = rng.random_range(0.0..f64::from(SIZE.width));
    let across: f64 = rng.random_range(-3.3..3.3);
    let y = row[1] + (across - row[4] * (x - row[0])) / row[5];
    let inside = (0.0..f64::from(SIZE.height)).contains(&y);
    (inside && exponent(row, [x, y]) <= 255f64.ln()).then_some([x, y])
}

/// Gaussians rounded to single precision.
struct Batch {
    count: usize,
    means: Vec<f32>,
    quats: Vec<f32>,
    scales: Vec<f32>,
}

impl Batch {
    fn random(count: usize, rng: &mut Pcg64Mcg) -> Self {
        let mut batch = Self {
            count,
            means: Vec::with_capacity(3 * count),
            quats: Vec::with_capacity(4 * count),
            scales: Vec::with_capacity(3 * count),
        };
        for _ in 0..count {
            let depth = 10f64.powf(rng.random_range(-1.5..3.0));
            let at = |rng: &mut Pcg64Mcg| depth * rng.random_range(-0.8..0.8);
            batch
                .means
                .extend([at(rng) as f32, at(rng) as f32, depth as f32]);
            let length = 10f64.powf(rng.random_range(-9.0..9.0));
            batch
                .quats
                .extend((0..4).map(|_| (length * rng.random_range(-1.0..1.0)) as f32));
            // The long axis in pixels; the others are up to 10,000 times shorter.
            let long = 10f64.powf(rng.random_range(0.0..4.0)) * depth / INTRINSICS[0];
            let mut axes = [0.0, -1.0, -1.0].map(|share: f64| {
                let shorter = -share * rng.random_range(0.0..4.0);
                (long * 10f64.powf(-shorter)) as f32
            });
            axes.swap(0, rng.random_range(0..3));
            batch.scales.extend(axes);
        }
        batch
    }

    fn project(&self, device: &Device, dtype: DType) -> Result<Vec<f64>, AccuracyError> {
        let n = self.count;
        let tensor = |values: &[f32], shape: [usize; 2]| {
            Tensor::<2>::from_data(TensorData::new(values.to_vec(), shape), (device, dtype))
        };
        let intrinsics = INTRINSICS.map(|x| x as f32);
        let projected = project(
            tensor(&self.means, [n, 3]),
            tensor(&self.quats, [n, 4]),
            tensor(&self.scales, [n, 3]),
            Tensor::<2>::eye(4, device).cast(dtype).unsqueeze(),
            tensor(&intrinsics, [1, 4]),
            SIZE,
            &ProjectSettings::default(),
        )?;
        let packed = projected.packed().try_into_vec_as::<f64>();
        packed.map_err(|error| AccuracyError::Read(error.to_string()))
    }
}
