//! Scores of Gaussians by the edges of the photos that they are seen on (Deng et al. 2025,
//! *Improving Densification in 3D Gaussian Splatting*, edge-aware score).

use burn::tensor::{Tensor, TensorData};
use splat_ops::OpError;
use splat_ops::device::to_host;

use super::super::{TrainingViews, weighted_contributions};
use crate::{RenderSettings, SplatModel};

/// Red, green and blue in grey (ITU-R BT.601).
const GREY: [f64; 3] = [0.299, 0.587, 0.114];
/// Edges that differ by less are those of a photo without any: the grey of an 8-bit photo has
/// steps of 0.114 / 255.
const LEAST_RANGE: f64 = 1e-4;

/// Edges of a photo `[1, H, W, 3]`, as `[1, H, W, 1]` from 0 to 1: the absolute value of the
/// Laplacian of its grey, 8 in the centre and -1 around, min-max normalised. The pixels of the
/// border repeat beyond it.
pub(in super::super) fn edge_map(photo: Tensor<4>) -> Tensor<4> {
    let device = photo.device();
    let weights = TensorData::new(GREY.to_vec(), [1, 1, 1, 3]);
    let weights = Tensor::<4>::from_data(weights, (&device, photo.dtype()));
    let grey = (photo * weights).sum_dim(3);
    let around = three(three(grey.clone(), 1), 2);
    let laplacian = (grey * 9.0 - around).abs();
    let [least, most] = [laplacian.clone().min(), laplacian.clone().max()];
    let range = (most - least.clone()).clamp_min(LEAST_RANGE);
    (laplacian - least.reshape([1, 1, 1, 1])) / range.reshape([1, 1, 1, 1])
}

/// Sum of each pixel and its two neighbours along a dimension.
fn three(image: Tensor<4>, dim: usize) -> Tensor<4> {
    let size = image.dims()[dim];
    if size == 1 {
        return image * 3.0;
    }
    let before = Tensor::cat(
        vec![
            image.clone().narrow(dim, 0, 1),
            image.clone().narrow(dim, 0, size - 1),
        ],
        dim,
    );
    let after = Tensor::cat(
        vec![
            image.clone().narrow(dim, 1, size - 1),
            image.clone().narrow(dim, size - 1, 1),
        ],
        dim,
    );
    image + before + after
}

/// The mean over views of the edges that each Gaussian is seen on, `Σ_p w_i(p) E(p)`, relative to
/// the mean of those that are seen on any.
///
/// Edges are of the photos as they are in memory, masked pixels included.
pub(super) fn edge_scores<M: SplatModel>(
    model: &M,
    views: &dyn TrainingViews,
    chosen: &[usize],
    settings: &RenderSettings,
) -> Result<Vec<f64>, OpError> {
    let seen = |view: &usize| -> Result<Vec<f64>, OpError> {
        let edges = edge_map(views.photo(*view)?);
        let seen = weighted_contributions(model, &views.camera(*view), settings, edges)?;
        Ok(to_host(seen)?.into_iter().map(f64::from).collect())
    };
    let seen = (chosen.iter().map(seen)).collect::<Result<Vec<_>, OpError>>()?;
    Ok(match seen.is_empty() {
        true => vec![0.0; model.count()],
        false => relative_scores(&seen),
    })
}

/// The mean over views of what each saw, relative to the mean of what is positive in it.
pub(in super::super) fn relative_scores(views: &[Vec<f64>]) -> Vec<f64> {
    let mut scores = vec![0.0; views.first().map_or(0, Vec::len)];
    for seen in views {
        let positive = seen.iter().filter(|value| **value > 0.0);
        let (sum, count) = positive.fold((0.0, 0usize), |(sum, n), value| (sum + value, n + 1));
        let factor = count as f64 / (sum * views.len() as f64);
        // A view that sees nothing says nothing.
        if factor.is_finite() {
            for (score, value) in scores.iter_mut().zip(seen) {
                *score += if *value > 0.0 { value * factor } else { 0.0 };
            }
        }
    }
    scores
}

/// So many of `count` views, spread over all of them; in the next turn their neighbours, so that
/// every view has its turn.
pub(super) fn views_in_turn(count: usize, chosen: usize, turn: usize) -> Vec<usize> {
    let chosen = chosen.min(count);
    (0..chosen)
        .map(|view| (turn % count + view * count / chosen) % count)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scores_are_relative_to_the_mean_of_what_is_seen() {
        let views = [vec![0.0, 1.0, 3.0, f64::NAN], vec![0.0; 4]];
        assert_eq!(relative_scores(&views), [0.0, 0.25, 0.75, 0.0]);
        assert!(relative_scores(&[]).is_empty());
    }

    #[test]
    fn every_view_has_its_turn() {
        assert_eq!(
            views_in_turn(30, 10, 0),
            [0, 3, 6, 9, 12, 15, 18, 21, 24, 27]
        );
        assert_eq!(views_in_turn(3, 10, 7), [1, 2, 0]);
        assert!(views_in_turn(0, 10, 1).is_empty());
        for count in [1usize, 7, 28, 43, 301] {
            let turns = count.div_ceil(10);
            let mut seen: Vec<_> = (0..turns)
                .flat_map(|t| views_in_turn(count, 10, t))
                .collect();
            seen.sort_unstable();
            seen.dedup();
            assert_eq!(seen.len(), count);
        }
    }
}

#[cfg(all(test, feature = "cpu"))]
mod image_tests {
    use burn::tensor::Device;

    use super::*;

    fn edges_of(levels: &[[f32; 3]], height: usize, width: usize) -> Vec<f32> {
        let photo = TensorData::new(levels.concat(), [1, height, width, 3]);
        let photo = Tensor::from_data(photo, &Device::flex());
        edge_map(photo).into_data().try_to_vec().unwrap()
    }

    #[test]
    fn a_point_is_an_edge_and_so_is_what_is_around_it() {
        let mut levels = [[0.5; 3]; 25];
        levels[12] = [1.0; 3];
        let found = edges_of(&levels, 5, 5);
        for (pixel, edge) in found.iter().enumerate() {
            let (y, x) = (pixel / 5, pixel % 5);
            let expected = match (y, x) {
                (2, 2) => 1.0,
                (1..4, 1..4) => 1.0 / 8.0,
                _ => 0.0,
            };
            assert!((edge - expected).abs() < 1e-5, "{y} {x}: {edge}");
        }
    }

    #[test]
    fn a_photo_of_one_colour_has_no_edges_not_even_at_its_border() {
        for (height, width) in [(4, 3), (1, 1), (1, 5)] {
            let levels = vec![[0.1, 0.7, 0.3]; height * width];
            let found = edges_of(&levels, height, width);
            assert!(found.iter().all(|edge| edge.abs() < 0.02), "{found:?}");
        }
    }
}
