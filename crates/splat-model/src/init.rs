//! Initial Gaussians from SfM points (3DGS section 5.1).

use core::num::NonZero;
use derive_setters::Setters;
use std::collections::HashMap;

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use serde::{Deserialize, Serialize};
use splat_core::{SH_C0, sh_coefficient_count};

use splat_data::SceneScale;
use splat_data::SplatData;

use crate::opacity::logit;

/// 8-bit level at which a channel starts that is 0 in the photos.
const DARKEST_LEVEL: f64 = 0.5;

/// Settings for the initial Gaussians.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Setters)]
#[serde(default, deny_unknown_fields)]
#[setters(prefix = "with_", strip_option)]
pub struct InitSettings {
    /// Opacity of every Gaussian, between 1/255 (below which nothing is drawn) and 1. Default 0.1.
    pub opacity: f64,
    /// Factor of the scale, which is the root mean square distance to the nearest points. Default
    /// 1.
    pub scale: f64,
    /// Highest degree of spherical harmonics to allocate. Default 3.
    pub sh_degree: usize,
}

impl InitSettings {
    /// The defaults; `with_*` methods change them one by one.
    pub fn new() -> Self {
        Self::default()
    }
}

impl Default for InitSettings {
    fn default() -> Self {
        Self {
            opacity: 0.1,
            scale: 1.0,
            sh_degree: 3,
        }
    }
}

/// Why points cannot start a scene.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum InitError {
    /// There are no points.
    #[error("no points to start from; the capture needs SfM points (points3D)")]
    NoPoints,
    /// A point is not finite.
    #[error(
        "point {index} of the capture (points3D, counted from 0) lies beyond what 32-bit floats hold; remove it"
    )]
    NotFinite {
        /// Index of the point.
        index: usize,
    },
}

/// Makes one Gaussian per point, with the point's colour, an isotropic scale (the root mean square
/// distance to the three nearest neighbours) and no rotation.
///
/// Everything starts within reach of gradients. Only points in other places count as neighbours,
/// since coincident points would give a size of zero (if all coincide, `scene` gives the size). A
/// channel of level 0 starts at half a level, above the clamp of colours at zero.
///
/// # Errors
/// When there are no points, or one is not finite.
pub fn splats_from_points(
    positions: &[[f32; 3]],
    colors: &[[u8; 3]],
    scene: SceneScale,
    settings: &InitSettings,
) -> Result<SplatData, InitError> {
    if positions.is_empty() {
        return Err(InitError::NoPoints);
    }
    if let Some(index) = positions
        .iter()
        .position(|p| p.iter().any(|x| !x.is_finite()))
    {
        return Err(InitError::NotFinite { index });
    }
    let n = positions.len();
    let log_scales = neighbour_distances(positions)
        .into_iter()
        .map(|distance| {
            let scale = distance.unwrap_or(scene.length()) * settings.scale;
            [scale.ln() as f32; 3]
        })
        .collect();
    let level = |channel: u8| f64::from(channel).max(DARKEST_LEVEL) / 255.0;
    let sh0 = |color: &[u8; 3]| color.map(|channel| ((level(channel) - 0.5) / SH_C0) as f32);
    let opacity = settings.opacity;
    Ok(SplatData {
        means: positions.to_vec(),
        log_scales,
        quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![logit(opacity) as f32; n],
        sh0: colors.iter().map(sh0).collect(),
        sh_rest: vec![0.0; n * (sh_coefficient_count(settings.sh_degree) - 1) * 3],
        sh_degree: settings.sh_degree,
        ..SplatData::default()
    })
}

/// Root mean square distance of each point to the three nearest other positions (fewer if there are
/// fewer); `None` if all points coincide.
fn neighbour_distances(positions: &[[f32; 3]]) -> Vec<Option<f64>> {
    const NEIGHBOURS: usize = 3;
    // Zero and minus zero are the same position.
    let place = |position: &[f32; 3]| position.map(|x| (x + 0.0).to_bits());
    let mut indices = HashMap::with_capacity(positions.len());
    let mut places: Vec<[f64; 3]> = Vec::with_capacity(positions.len());
    for position in positions {
        indices.entry(place(position)).or_insert_with(|| {
            places.push(position.map(f64::from));
            places.len() - 1
        });
    }
    let count = match NonZero::new((NEIGHBOURS + 1).min(places.len())) {
        Some(count) if places.len() > 1 => count,
        _ => return vec![None; positions.len()],
    };
    let tree = ImmutableKdTree::<f64, 3>::new_from_slice(&places)
        .expect("indices of points fit the tree's, which are 64 bits");
    let distances: Vec<f64> = places
        .iter()
        .map(|point| {
            // The nearest position is the point's own.
            let nearest = tree
                .query(point)
                .nearest_n::<SquaredEuclidean<f64>>(count)
                .execute();
            let others = nearest.len().saturating_sub(1).max(1);
            let total: f64 = nearest.iter().map(|neighbour| neighbour.distance).sum();
            (total / others as f64).sqrt()
        })
        .collect();
    let distance = |position: &[f32; 3]| Some(distances[*indices.get(&place(position))?]);
    positions.iter().map(distance).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene() -> SceneScale {
        SceneScale::new(5.0).unwrap()
    }

    #[test]
    fn scales_come_from_the_three_nearest_points() {
        let positions = [
            [0.0, 0.0, 0.0],
            [1.0, 0.0, 0.0],
            [0.0, 2.0, 0.0],
            [0.0, 0.0, 3.0],
            [9.0; 3],
        ];
        let colors = [[255, 0, 128]; 5];
        let splats = splats_from_points(&positions, &colors, scene(), &Default::default()).unwrap();
        let expected = ((1.0 + 4.0 + 9.0) / 3.0f64).sqrt().ln();
        assert!((f64::from(splats.log_scales[0][0]) - expected).abs() < 1e-6);
        assert_eq!(splats.sh_rest.len(), 5 * 15 * 3);
        // Four points at the position of the first change nothing for it, and get its scale.
        let mut doubled = positions.to_vec();
        doubled.extend([[0.0; 3], [-0.0; 3], [0.0; 3], [0.0; 3]]);
        let colors = [[9; 3]; 9];
        let again = splats_from_points(&doubled, &colors, scene(), &Default::default()).unwrap();
        assert_eq!(again.log_scales[..5], splats.log_scales);
        assert_eq!(again.log_scales[5..], [splats.log_scales[0]; 4]);
    }

    #[test]
    fn points_in_one_place_are_as_large_as_the_scene() {
        for n in [1, 2, 3, 1000] {
            let points = vec![[1.0, 2.0, 3.0]; n];
            let splats =
                splats_from_points(&points, &vec![[9; 3]; n], scene(), &Default::default());
            assert_eq!(splats.unwrap().log_scales, vec![[5.0f32.ln(); 3]; n]);
        }
    }

    /// `max(SH + 0.5, 0)` passes no gradient below zero.
    #[test]
    fn no_colour_starts_below_the_clamp() {
        let colors: Vec<[u8; 3]> = (0..=255).map(|level| [level; 3]).collect();
        let points: Vec<[f32; 3]> = (0..=255).map(|i| [i as f32, 0.0, 0.0]).collect();
        let splats = splats_from_points(&points, &colors, scene(), &Default::default()).unwrap();
        for (level, sh0) in splats.sh0.iter().enumerate() {
            let color = sh0[0] * SH_C0 as f32 + 0.5;
            assert!(color > 0.0, "level {level} starts at {color:e}");
            assert!(
                (color * 255.0 - level as f32).abs() <= 0.501,
                "level {level}: {color}"
            );
        }
    }

    #[test]
    fn bad_points_are_named() {
        let settings = InitSettings::default();
        assert_eq!(
            splats_from_points(&[], &[], scene(), &settings),
            Err(InitError::NoPoints)
        );
        let points = [[0.0; 3], [f32::NAN, 0.0, 0.0]];
        assert_eq!(
            splats_from_points(&points, &[[0; 3]; 2], scene(), &settings),
            Err(InitError::NotFinite { index: 1 })
        );
    }
}
