//! Fewer Gaussians: those with the least weight in the pictures go first.

use burn::tensor::Tensor;
use splat_data::SplatData;
use splat_model::ops::OpError;
use splat_model::ops::device::to_host;
use splat_model::strategy::weighted_contributions;

use super::{Judge, largest, questions};

/// Parts of a scene that are tried: a thousandth of all Gaussians is not worth a render of all
/// views.
const PARTS: usize = 256;

/// The weight of each Gaussian in all pictures of the views, `Σ_p w_i(p)`, in pixels.
///
/// # Errors
/// When an op refuses its input, or the device fails.
pub fn contributions(splats: &SplatData, judge: &Judge) -> Result<Vec<f64>, OpError> {
    let (model, settings) = judge.model(splats);
    let mut sums = vec![0.0; splats.len()];
    for cameras in judge.cameras(splats.origin) {
        let size = cameras.size;
        let shape = [1, size.height as usize, size.width as usize, 1];
        let ones = Tensor::ones(shape, &cameras.viewmats.device());
        let view = weighted_contributions(&model, &cameras, &settings, ones)?;
        for (sum, weight) in sums.iter_mut().zip(to_host(view)?) {
            *sum += f64::from(weight);
        }
    }
    Ok(sums)
}

/// As few of the Gaussians as have this PSNR, and the PSNR that they have.
pub(super) fn prune(
    splats: &SplatData,
    judge: &Judge,
    floor: f64,
    mut progress: impl FnMut(usize, usize),
) -> Result<(SplatData, f64), OpError> {
    let all = questions(PARTS) + 2;
    progress(0, all);
    let weights = contributions(splats, judge)?;
    let mut order: Vec<usize> = (0..splats.len()).collect();
    // The least first; of equals the last.
    order.sort_by(|a, b| weights[*a].total_cmp(&weights[*b]).then(b.cmp(a)));
    // What is in no picture costs nothing.
    let unseen = weights.iter().filter(|weight| !(**weight > 0.0)).count();
    let without = |removed: usize| {
        let mut kept: Vec<usize> = order[removed..].to_vec();
        kept.sort_unstable();
        splats.select(&kept)
    };
    let seen = splats.len() - unseen;
    let removed = |part: usize| unseen + seen * part / PARTS;
    let mut done = 1;
    // A scene keeps a Gaussian.
    let most = PARTS.saturating_sub(1).min(seen.saturating_sub(1));
    let part = largest(most, |part| {
        progress(done, all);
        done += 1;
        Ok(judge.psnr(&without(removed(part)))? >= floor)
    })?;
    let pruned = without(removed(part).min(splats.len().saturating_sub(1)));
    let psnr = judge.psnr(&pruned)?;
    progress(all, all);
    Ok((pruned, psnr))
}
