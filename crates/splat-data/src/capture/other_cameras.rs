//! The cameras of another model, such as the refined ones of a run, for the views of a capture.

use std::collections::HashMap;
use std::path::Path;

use super::{CaptureError, CaptureSettings, CaptureWarning, View, colmap};

/// Gives each view the camera, lens and pose that the COLMAP model in `folder` has for the image of
/// its name. Photos, masks and split stay those of the capture.
pub(super) fn take(
    folder: &Path,
    views: &mut [View],
    warnings: &mut Vec<CaptureWarning>,
) -> Result<(), CaptureError> {
    let (model, about_model) = colmap::read(folder, &CaptureSettings::new())?;
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
        let Some(intrinsics) = camera.intrinsics.fit(photo) else {
            let size = camera.intrinsics.size().unwrap_or_default();
            return Err(wrong(
                view,
                format!(
                    "its camera is of a photo of {}x{}, not {}x{}, which is no other scale of it",
                    size[0], size[1], photo[0], photo[1]
                ),
            ));
        };
        let size = camera.intrinsics.size().filter(|size| *size != photo);
        rescaled.extend(size.map(|camera| (view.name.clone(), [photo, camera])));
        view.intrinsics = intrinsics;
        view.lens = camera.lens;
        view.viewmat = image.viewmat;
    }
    let rescaled = rescaled.iter().map(|(name, sizes)| (&**name, *sizes));
    warnings.extend(CaptureWarning::rescaled(rescaled));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::test_capture::TestCapture;
    use crate::{Capture, CaptureError, CaptureSettings, Lens, SplitRule};

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

        // Cameras of photos of half the size fit the whole ones, with a warning.
        let whole = Capture::load(folder.path(), &settings.clone().with_downscale(1)).unwrap();
        let warned = whole
            .warnings
            .iter()
            .any(|w| w.to_string().contains("scaled to the photos"));
        assert!(warned, "{:?}", whole.warnings);

        refined.views.pop();
        std::fs::remove_dir_all(&model).unwrap();
        refined.save_model(&model).unwrap();
        let error = Capture::load(folder.path(), &settings).unwrap_err();
        assert!(matches!(error, CaptureError::BadRecord { .. }), "{error}");
        let missing = &own.views.last().unwrap().name;
        assert!(error.to_string().contains(&**missing), "{error}");
    }
}
