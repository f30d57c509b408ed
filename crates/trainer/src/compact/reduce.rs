//! Lower degrees of spherical harmonics, where the colour hardly depends on the direction.

use burn::tensor::Tensor;
use splat_data::SplatData;
use splat_model::ops::device::to_host;
use splat_model::ops::{OpError, SH_DEGREE_MAX, sh_coefficient_count};
use splat_model::strategy::weighted_contributions;

use super::{Judge, largest, questions};

/// The value of the constant harmonic, `1 / (2 sqrt(pi))`.
const CONSTANT: f64 = 0.282_094_791_773_878_14;
/// Thresholds of the change of a colour that are tried: from a tenth of a level of 8 bits to
/// almost all, in steps of a tenth.
const THRESHOLDS: usize = 80;

fn threshold(index: usize) -> f64 {
    match index {
        0 => 0.0,
        _ => 0.1 / 255.0 * 1.1f64.powi(index as i32),
    }
}

/// How the colours of the Gaussians change over the views.
struct Changes {
    /// Root of the mean squared change of the colour if the degree is lowered to 0, 1 or 2.
    error: [Vec<f64>; SH_DEGREE_MAX],
    /// Constant coefficients of the mean colours.
    constant: Vec<[f32; 3]>,
}

/// Lowers degrees as far as the scene keeps this PSNR.
pub(super) fn reduce(
    (splats, psnr): (SplatData, f64),
    judge: &Judge,
    floor: f64,
    mut progress: impl FnMut(usize, usize),
) -> Result<(SplatData, f64), OpError> {
    if splats.sh_degree == 0 || splats.is_empty() {
        return Ok((splats, psnr));
    }
    let all = questions(THRESHOLDS) + 2;
    progress(0, all);
    let changes = Changes::measure(&splats, judge)?;
    let mut done = 1;
    let best = largest(THRESHOLDS, |index| {
        progress(done, all);
        done += 1;
        Ok(judge.psnr(&changes.lowered(&splats, threshold(index)))? >= floor)
    })?;
    let lowered = changes
        .lowered(&splats, threshold(best))
        .with_lowest_degree();
    let psnr = judge.psnr(&lowered)?;
    progress(all, all);
    Ok((lowered, psnr))
}

impl Changes {
    /// Of all views, each weighted by the weight of the Gaussian in its picture.
    fn measure(splats: &SplatData, judge: &Judge) -> Result<Self, OpError> {
        let (model, settings) = judge.model(splats);
        let n = splats.len();
        let highest = splats.sh_degree;
        let mut weights = vec![0.0; n];
        let mut sums = vec![[0.0; 3]; n];
        let mut squares = vec![0.0; n];
        let mut error: [Vec<f64>; SH_DEGREE_MAX] = std::array::from_fn(|_| vec![0.0; n]);
        for cameras in judge.cameras(splats.origin) {
            let size = cameras.size;
            let shape = [1, size.height as usize, size.width as usize, 1];
            let ones = Tensor::ones(shape, &cameras.viewmats.device());
            let weight = to_host(weighted_contributions(&model, &cameras, &settings, ones)?)?;
            let colors = |degree: usize| -> Result<Vec<f32>, OpError> {
                to_host(model.colors(cameras.centers(), degree, None)?)
            };
            let full = colors(highest)?;
            let full = full.as_chunks::<3>().0;
            for (i, (color, weight)) in full.iter().zip(&weight).enumerate() {
                let weight = f64::from(*weight);
                weights[i] += weight;
                for (sum, x) in sums[i].iter_mut().zip(color) {
                    *sum += weight * f64::from(*x);
                    squares[i] += weight * f64::from(*x).powi(2);
                }
            }
            for degree in 1..highest {
                let lower = colors(degree)?;
                let pairs = lower.as_chunks::<3>().0.iter().zip(full);
                for (i, ((a, b), weight)) in pairs.zip(&weight).enumerate() {
                    let far = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2));
                    error[degree][i] += f64::from(*weight) * far.sum::<f64>();
                }
            }
        }
        let mut constant = splats.sh0.clone();
        for i in 0..n {
            let weight = weights[i];
            if !(weight > 0.0) {
                // Its colour is nowhere seen.
                continue;
            }
            let mean = sums[i].map(|sum: f64| sum / weight);
            constant[i] = mean.map(|mean| ((mean - 0.5) / CONSTANT) as f32);
            let spread = squares[i] / weight - mean.iter().map(|x| x * x).sum::<f64>();
            error[0][i] = spread.max(0.0).sqrt();
            for degree in 1..highest {
                error[degree][i] = (error[degree][i] / weight).sqrt();
            }
        }
        Ok(Self { error, constant })
    }

    /// The scene with the lowest degrees whose colours change by at most this.
    fn lowered(&self, splats: &SplatData, most: f64) -> SplatData {
        let mut lowered = splats.clone();
        let width = splats.sh_rest_len();
        for i in 0..splats.len() {
            let Some(degree) = (0..splats.sh_degree).find(|d| self.error[*d][i] <= most) else {
                continue;
            };
            let rest = &mut lowered.sh_rest[i * width..(i + 1) * width];
            rest[3 * (sh_coefficient_count(degree) - 1)..].fill(0.0);
            if degree == 0 {
                lowered.sh0[i] = self.constant[i];
            }
        }
        lowered
    }
}

/// Gaussians by the highest degree of which they have a coefficient.
pub(super) fn degrees(splats: &SplatData) -> [usize; 4] {
    let mut counts = [0; 4];
    for i in 0..splats.len() {
        counts[splats.degree_of(i)] += 1;
    }
    counts
}
