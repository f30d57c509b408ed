//! Initial Gaussians from SfM points (3DGS section 5.1).

use core::num::NonZero;

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use serde::{Deserialize, Serialize};
use splat_ops::sh_coefficient_count;

use crate::Camera;
use crate::files::SplatData;

/// Value of the constant spherical harmonic, 1 / (2 sqrt(pi)).
const SH_C0: f64 = 0.282_094_791_773_878_14;

/// How the first Gaussians are made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct InitSettings {
    /// Opacity of every Gaussian. Default 0.1.
    pub opacity: f64,
    /// Scale, in root mean squares of the distances to the nearest points. Default 1.
    pub scale: f64,
    /// Highest degree of spherical harmonics to make room for. Default 3.
    pub sh_degree: usize,
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

/// Points that no scene can start from.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum InitError {
    /// There is none.
    #[error("no points to start from; the capture needs SfM points (points3D)")]
    NoPoints,
    /// One is not finite.
    #[error("point {index} has a position that is not finite; remove it from the capture")]
    NotFinite {
        /// Which one.
        index: usize,
    },
}

/// One Gaussian per point: the point's colour, an isotropic scale of the root mean square of the
/// distances to its three nearest neighbours, no rotation.
///
/// `extent` is the size of the scene in world units; it bounds the scale from below (by 1e-7 of it),
/// where points coincide, and is the scale of a single point.
///
/// # Errors
/// When there is no point or one is not finite.
pub fn splats_from_points(
    positions: &[[f32; 3]],
    colors: &[[u8; 3]],
    extent: f64,
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
            let distance = if n > 1 { distance } else { extent };
            let scale = (distance * settings.scale).max(extent * 1e-7).max(1e-20);
            [scale.ln() as f32; 3]
        })
        .collect();
    let sh0 =
        |color: &[u8; 3]| color.map(|channel| ((f64::from(channel) / 255.0 - 0.5) / SH_C0) as f32);
    let opacity = settings.opacity.clamp(1e-6, 1.0 - 1e-6);
    Ok(SplatData {
        means: positions.to_vec(),
        log_scales,
        quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![(opacity / (1.0 - opacity)).ln() as f32; n],
        sh0: colors.iter().map(sh0).collect(),
        sh_rest: vec![0.0; n * (sh_coefficient_count(settings.sh_degree) - 1) * 3],
        sh_degree: settings.sh_degree,
        ..SplatData::default()
    })
}

/// Per point the root mean square of the distances to its three nearest neighbours (fewer where
/// there are fewer), zero for a single point.
fn neighbour_distances(positions: &[[f32; 3]]) -> Vec<f64> {
    const NEIGHBOURS: usize = 3;
    let points: Vec<[f64; 3]> = positions.iter().map(|p| p.map(f64::from)).collect();
    // The nearest point is the point itself.
    let (Ok(tree), Some(count)) = (
        ImmutableKdTree::<f64, 3>::new_from_slice(&points),
        NonZero::new((NEIGHBOURS + 1).min(points.len())),
    ) else {
        return vec![0.0; points.len()];
    };
    points
        .iter()
        .map(|point| {
            let nearest = tree
                .query(point)
                .nearest_n::<SquaredEuclidean<f64>>(count)
                .execute();
            let others = nearest.len().saturating_sub(1).max(1);
            let total: f64 = nearest.iter().map(|neighbour| neighbour.distance).sum();
            (total / others as f64).sqrt()
        })
        .collect()
}

/// Where the means of a scene should count from: the world's zero, unless it is so far away that 32-bit floats
/// would round visible detail away; then the middle of the cameras, in whole units.
pub fn scene_origin(cameras: &[Camera]) -> [f64; 3] {
    /// From 100 scenes away on, a float resolves less than 1e-5 of the scene.
    const FAR: f64 = 100.0;
    let positions = cameras.iter().map(Camera::position);
    let mean = positions.sum::<glam::DVec3>() / cameras.len().max(1) as f64;
    if mean.abs().max_element() > FAR * scene_scale(cameras) {
        mean.round().to_array()
    } else {
        [0.0; 3]
    }
}

/// Size of a scene as 3DGS measures it: 1.1 times the largest distance of a camera from the mean
/// camera, in world units. With one camera, or several in one place, 1.
pub fn scene_scale(cameras: &[Camera]) -> f64 {
    let positions: Vec<_> = cameras.iter().map(Camera::position).collect();
    let mean = positions.iter().sum::<glam::DVec3>() / positions.len().max(1) as f64;
    let radius = positions
        .iter()
        .map(|position| position.distance(mean))
        .fold(0.0, f64::max);
    if radius > 0.0 { 1.1 * radius } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_come_from_the_three_nearest_points() {
        let positions = [
            [0.0, 0.0, 0.0],
            [1.0, 0.0, 0.0],
            [0.0, 2.0, 0.0],
            [0.0, 0.0, 3.0],
            [9.0; 3],
        ];
        let splats =
            splats_from_points(&positions, &[[255, 0, 128]; 5], 1.0, &Default::default()).unwrap();
        let expected = ((1.0 + 4.0 + 9.0) / 3.0f64).sqrt().ln();
        assert!((f64::from(splats.log_scales[0][0]) - expected).abs() < 1e-6);
        assert_eq!(splats.sh_rest.len(), 5 * 15 * 3);
    }

    #[test]
    fn only_a_scene_far_from_zero_gets_an_origin() {
        let camera = |x: f64, y: f64| Camera {
            viewmat: glam::DMat4::from_translation(glam::DVec3::new(-x, -y, 0.0)),
            intrinsics: [50.0, 50.0, 8.0, 8.0],
            size: splat_ops::ImageSize {
                width: 16,
                height: 16,
            },
        };
        let near = [camera(0.0, 3.0), camera(2.0, 3.0), camera(4.0, 50.0)];
        assert_eq!(scene_origin(&near), [0.0; 3]);
        let far = [camera(4e6, 3.25), camera(4e6 + 2.0, 3.5)];
        assert_eq!(scene_origin(&far), [4_000_001.0, 3.0, 0.0]);
    }

    #[test]
    fn coincident_points_and_single_points_get_a_finite_scale() {
        for n in [1, 2, 3, 1000] {
            let splats = splats_from_points(
                &vec![[1.0, 2.0, 3.0]; n],
                &vec![[9; 3]; n],
                5.0,
                &Default::default(),
            )
            .unwrap();
            assert!(splats.log_scales.iter().flatten().all(|x| x.is_finite()));
        }
    }

    #[test]
    fn bad_points_are_named() {
        let settings = InitSettings::default();
        assert_eq!(
            splats_from_points(&[], &[], 1.0, &settings),
            Err(InitError::NoPoints)
        );
        let points = [[0.0; 3], [f32::NAN, 0.0, 0.0]];
        assert_eq!(
            splats_from_points(&points, &[[0; 3]; 2], 1.0, &settings),
            Err(InitError::NotFinite { index: 1 })
        );
    }
}
