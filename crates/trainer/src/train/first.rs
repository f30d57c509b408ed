//! Initial Gaussians of a run.

use splat_data::{Capture, SceneScale, SplatData};
use splat_model::{InitSettings, splats_from_points};

use super::TrainError;

/// Default limit of Gaussians: seven for every ten pixels of a photo, or one for every hundred
/// pixels of all training photos, whichever is more; and of that a share.
pub(super) fn default_max_gaussians(capture: &Capture, share: f64) -> usize {
    let pixels = |view: &usize| {
        let view = &capture.views[*view];
        view.width as usize * view.height as usize
    };
    let photos = capture.split.train.iter().map(pixels);
    let most = (photos.clone().sum::<usize>() / 100).max(photos.max().unwrap_or(0) * 7 / 10);
    ((most as f64 * share) as usize).max(1)
}

/// One Gaussian per point of the capture, at these positions, relative to the origin.
pub(super) fn first_gaussians(
    capture: &Capture,
    points: &[[f64; 3]],
    settings: &InitSettings,
    scale: SceneScale,
    origin: [f64; 3],
) -> Result<SplatData, TrainError> {
    let positions: Vec<_> = points
        .iter()
        .map(|p| std::array::from_fn(|axis| (p[axis] - origin[axis]) as f32))
        .collect();
    let colors: Vec<_> = capture.points.iter().map(|p| p.color).collect();
    let splats = splats_from_points(&positions, &colors, scale, settings);
    let mut splats = splats.map_err(|source| TrainError::Init {
        capture: capture.root.clone(),
        source,
    })?;
    splats.origin = origin;
    Ok(splats)
}
