//! The cameras of another model, such as the refined ones of a run, for the views of a capture.

use std::collections::HashMap;
use std::path::Path;

use super::{CaptureError, CaptureSettings, CaptureWarning, View, colmap};

/// Gives each view the camera, lens and pose that the COLMAP model in `folder` has for the image of
/// its name. Photos, masks and split stay those of the capture.
pub(super) fn take(
    folder: &Path,
    downscale: u32,
    views: &mut [View],
    warnings: &mut Vec<CaptureWarning>,
) -> Result<(), CaptureError> {
    let read = colmap::read(folder, &CaptureSettings::new());
    let (model, about_model) = read.map_err(|error| match error {
        CaptureError::NoModel { root } => CaptureError::NoCameras { folder: root },
        other => other,
    })?;
    warnings.extend(about_model);
    let by_name: HashMap<_, _> = (model.images.iter())
        .map(|image| (&*image.name, image))
        .collect();
    let wrong = |view: &View, reason: String| CaptureError::BadRecord {
        path: folder.to_path_buf(),
        record: format!("image {}", view.name),
        reason,
    };
    let mut rescaled = Vec::new();
    for view in views {
        let Some(image) = by_name.get(&*view.name) else {
            let reason = "not in this model; --cameras needs a camera for each view of the capture";
            return Err(wrong(view, reason.to_owned()));
        };
        let camera = &model.cameras[&image.camera_id];
        let photo = [view.width, view.height];
        let whole = (camera.intrinsics.pixels())
            .and_then(|(size, values)| Some((values, block_factor(size, photo, downscale)?)));
        let intrinsics = match whole {
            Some((values, factor)) => values.map(|value| value * factor),
            None => {
                let size = camera.intrinsics.size().unwrap_or_default();
                rescaled.push((view.name.clone(), [photo, size]));
                camera.intrinsics.fit(photo).ok_or_else(|| {
                    let reason = format!(
                        "its camera is of a photo of {}x{}, not {}x{}, which is no other scale of it",
                        size[0], size[1], photo[0], photo[1]
                    );
                    wrong(view, reason)
                })?
            }
        };
        view.intrinsics = intrinsics;
        view.lens = camera.lens;
        view.viewmat = image.viewmat;
    }
    let rescaled = rescaled.iter().map(|(name, sizes)| (&**name, *sizes));
    warnings.extend(CaptureWarning::rescaled(rescaled));
    Ok(())
}

/// Pixels of a photo for each of the camera's photo, if both are one photo averaged over blocks, of
/// `downscale` pixels and of any other number. What is left over at the edges is dropped, so that
/// the ratio of the sizes is not quite it.
fn block_factor(camera: [u32; 2], photo: [u32; 2], downscale: u32) -> Option<f64> {
    // Sides of the photos that have this side when averaged.
    let wholes = |side: u32, block: u64| u64::from(side) * block..(u64::from(side) + 1) * block;
    let block = u64::from(downscale);
    let of_one_photo = |other: &u64| {
        (camera.iter().zip(&photo)).all(|(camera, photo)| {
            let (camera, photo) = (wholes(*camera, *other), wholes(*photo, block));
            camera.start < photo.end && photo.start < camera.end
        })
    };
    let about = (u64::from(photo[0]) * block).checked_div(camera[0].into())?;
    let candidates = [about, about + 1, about.saturating_sub(1)];
    let found = candidates
        .into_iter()
        .find(|other| *other > 0 && of_one_photo(other));
    Some(found? as f64 / f64::from(downscale))
}

#[cfg(test)]
mod tests {
    use super::super::test_capture::TestCapture;
    use super::block_factor;
    use crate::{Capture, CaptureError, CaptureSettings, CaptureWarning, Lens, SplitRule};

    #[test]
    fn photos_in_blocks_are_scaled_by_the_blocks() {
        // 269 x 479 pixels, averaged by 8 and by 3, and whole.
        assert_eq!(block_factor([269, 479], [33, 59], 8), Some(0.125));
        assert_eq!(block_factor([33, 59], [269, 479], 1), Some(8.0));
        assert_eq!(block_factor([33, 59], [89, 159], 3), Some(8.0 / 3.0));
        assert_eq!(block_factor([33, 59], [33, 59], 8), Some(1.0));
        assert_eq!(block_factor([269, 479], [269, 479], 1), Some(1.0));
        // Made smaller by something else, and another photo.
        assert_eq!(block_factor([4946, 3286], [1237, 822], 1), None);
        assert_eq!(block_factor([269, 479], [479, 269], 1), None);
        assert_eq!(block_factor([0, 479], [1, 1], 1), None);
    }

    #[test]
    fn views_get_the_cameras_of_another_model() {
        let [folder, other] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let written = TestCapture::new();
        written.write_photos(folder.path());
        written.write_binary(&folder.path().join("sparse/0"));
        let settings = CaptureSettings::new().with_downscale(2);
        let settings = settings.with_split(SplitRule::Every(3));
        let own = Capture::load(folder.path(), &settings).unwrap();
        let mut refined = own.clone();
        for view in &mut refined.views {
            view.viewmat[1][3] += 0.25;
            view.intrinsics[0] *= 1.01;
            view.lens = Lens::OpenCv([-0.1, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        }
        let model = other.path().join("cameras");
        refined.save_model(&model).unwrap();

        let settings = settings.with_cameras(model.clone());
        let found = Capture::load(folder.path(), &settings).unwrap();
        assert_eq!(found.split, own.split);
        for ((found, refined), own) in found.views.iter().zip(&refined.views).zip(&own.views) {
            assert_eq!(
                (found.intrinsics, found.lens),
                (refined.intrinsics, refined.lens)
            );
            assert!((found.viewmat[1][3] - refined.viewmat[1][3]).abs() < 1e-12);
            assert_eq!((&found.name, &found.image), (&own.name, &own.image));
        }

        // Whole photos have twice as many pixels, whatever is cut off of the others.
        let whole = Capture::load(folder.path(), &settings.clone().with_downscale(1)).unwrap();
        for (found, refined) in whole.views.iter().zip(&refined.views) {
            assert_eq!(found.intrinsics, refined.intrinsics.map(|x| 2.0 * x));
        }
        let rescaled = |w: &CaptureWarning| matches!(w, CaptureWarning::RescaledPhotos { .. });
        assert!(!whole.warnings.iter().any(rescaled), "{:?}", whole.warnings);

        refined.views.pop();
        std::fs::remove_dir_all(&model).unwrap();
        refined.save_model(&model).unwrap();
        let error = Capture::load(folder.path(), &settings).unwrap_err();
        assert!(matches!(error, CaptureError::BadRecord { .. }), "{error}");
        let missing = &own.views.last().unwrap().name;
        assert!(error.to_string().contains(&**missing), "{error}");
    }
}
