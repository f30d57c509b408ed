//! Promises about photos that stay on the disk, and about the memory that decoded ones may take.

use tempfile::TempDir;

use super::masks::Masks;
use super::photo_loader::Loader;
use super::photo_memory::too_much;
use super::test_capture::TestCapture;
use super::*;

/// A capture with a mask for its first photo.
fn good() -> TempDir {
    let root = TempDir::new().unwrap();
    let capture = TestCapture::new();
    capture.write_photos(root.path());
    capture.write_binary(&root.path().join("sparse/0"));
    let mask = |x: u32, y: u32| image::Luma([(x * y) as u8]);
    std::fs::create_dir(root.path().join("masks")).unwrap();
    let path = root.path().join("masks/view r.png.png");
    image::GrayImage::from_fn(32, 24, mask).save(path).unwrap();
    root
}

fn load(root: &Path, options: &CaptureSettings) -> Capture {
    Capture::load(root, options).unwrap()
}

fn same(a: &View, b: &View) {
    assert_eq!((&a.name, a.width, a.height), (&b.name, b.width, b.height));
    assert_eq!(
        (a.intrinsics, a.viewmat, a.lens),
        (b.intrinsics, b.viewmat, b.lens)
    );
    assert_eq!((&a.image, &a.mask), (&b.image, &b.mask));
}

#[test]
fn a_photo_on_the_disk_is_the_same_once_it_is_loaded() {
    let root = good();
    for options in [
        CaptureSettings::new(),
        CaptureSettings::new().with_downscale(2),
    ] {
        let inside = load(root.path(), &options);
        let calls = std::sync::atomic::AtomicUsize::new(0);
        let count = |_, total: usize| {
            assert_eq!(total, 9);
            calls.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        };
        let bounded = options.with_memory(100);
        let outside = Capture::load_with_progress(root.path(), &bounded, &count).unwrap();
        assert_eq!(calls.into_inner(), 9);
        assert_eq!(outside.split, inside.split);
        let [
            ref warning @ CaptureWarning::PhotosOnDisk {
                photos: 9,
                bound: 100,
                ..
            },
            ..,
        ] = outside.warnings[..]
        else {
            panic!("a warning, not {:?}", outside.warnings);
        };
        assert!(warning.to_string().contains("--downscale"), "{warning}");
        for (outside, inside) in outside.views.iter().zip(&inside.views) {
            assert!(outside.on_disk.is_some() && outside.image.is_empty());
            same(&outside.loaded().unwrap(), inside);
            assert!(inside.on_disk.is_none());
            assert!(matches!(inside.loaded().unwrap(), Cow::Borrowed(_)));
        }
        assert!(outside.views[0].loaded().unwrap().mask.is_some());
    }
}

#[test]
fn a_photo_on_the_disk_can_be_downscaled() {
    let root = good();
    let inside = load(root.path(), &CaptureSettings::new());
    let outside = load(root.path(), &CaptureSettings::new().with_memory(0));
    let small = |view: &View| view.downscaled(2).downscaled(1);
    for (outside, inside) in outside.views.iter().zip(&inside.views) {
        let outside = small(outside);
        assert!(outside.image.is_empty());
        same(&outside.loaded().unwrap(), &small(inside));
    }
}

#[test]
fn a_changed_camera_is_kept() {
    let root = good();
    let mut capture = load(root.path(), &CaptureSettings::new().with_memory(0));
    let view = &mut capture.views[3];
    view.viewmat[0][3] = 7.5;
    view.intrinsics[0] = 99.0;
    view.lens = Lens::OpenCvFisheye([0.1; 4]);
    let loaded = view.loaded().unwrap().into_owned();
    assert_eq!(loaded.viewmat[0][3], 7.5);
    assert_eq!((loaded.intrinsics[0], loaded.lens), (99.0, view.lens));
}

#[test]
fn a_capture_on_the_disk_can_be_saved() {
    let root = good();
    let to = TempDir::new().unwrap();
    let options = CaptureSettings::new();
    load(root.path(), &options.clone().with_memory(0))
        .save(to.path())
        .unwrap();
    let (a, b) = (load(root.path(), &options), load(to.path(), &options));
    for (a, b) in a.views.iter().zip(&b.views) {
        assert_eq!((&a.image, &a.mask), (&b.image, &b.mask));
    }
}

#[test]
fn a_photo_that_is_gone_or_changed_is_named() {
    let root = good();
    let capture = load(root.path(), &CaptureSettings::new().with_memory(0));
    let (view, path) = (&capture.views[1], root.path().join("images/view s.png"));
    let message = |word: &str| {
        let message = view.loaded().unwrap_err().to_string();
        assert!(
            message.contains("view s.png") && message.contains(word),
            "{message}"
        );
    };
    image::RgbImage::new(64, 48).save(&path).unwrap();
    message("its size has changed");
    std::fs::write(&path, b"nothing").unwrap();
    message("cannot be decoded");
    std::fs::remove_file(&path).unwrap();
    message("No such file");
    // As for photos that are decoded at once.
    std::fs::write(&path, b"nothing").unwrap();
    let options = CaptureSettings::new().with_memory(0);
    let error = Capture::load(root.path(), &options).unwrap_err();
    assert!(error.to_string().contains("view s.png"), "{error}");
}

/// Measured by the photos' sizes if their cameras' are larger.
#[test]
fn photos_are_counted_before_they_are_decoded() {
    let root = good();
    let capture = load(root.path(), &CaptureSettings::new());
    let pixels: u64 = capture
        .views
        .iter()
        .map(|view| view.pixel_count() as u64)
        .sum();
    let (mut model, _) = colmap::read(root.path(), &CaptureSettings::new()).unwrap();
    for camera in model.cameras.values_mut() {
        if let sparse_model::Intrinsics::Pixels { size, .. } = &mut camera.intrinsics {
            *size = [u32::MAX; 2];
        }
    }
    let folder = root.path().join("images");
    let check = |factor: u32, masks: bool, bound: Option<u64>, left: Option<u64>| {
        let loader = Loader {
            folder: folder.clone(),
            masks: Masks::beside(if masks { root.path() } else { &folder }, &folder),
            factor,
            background: None,
        };
        too_much(root.path(), &loader, &model, bound, left)
    };
    let fits = |factor, masks, bound, left| check(factor, masks, bound, left).unwrap().is_none();
    assert!(fits(1, false, Some(3 * pixels), None));
    assert!(!fits(1, false, Some(3 * pixels - 1), None));
    assert!(fits(1, true, Some(4 * pixels), None));
    assert!(!fits(1, true, Some(4 * pixels - 1), None));
    assert!(fits(2, true, Some(pixels), None));
    assert!(fits(1, false, None, None));
    // Half of what is left, and never more than that.
    assert!(fits(1, false, None, Some(6 * pixels)));
    assert!(!fits(1, false, None, Some(6 * pixels - 2)));
    assert!(!fits(1, false, Some(9 * pixels), Some(3 * pixels - 1)));
    // One photo must fit.
    let one = 3 * 32 * 24;
    assert!(!fits(1, false, None, Some(one)));
    let error = check(1, false, None, Some(one - 1)).unwrap_err();
    assert!(matches!(
        error,
        CaptureError::OutOfMemory {
            needed: 2_304,
            left: 2_303,
            ..
        }
    ));
    let message = error.to_string();
    assert!(message.contains("smaller"), "{message}");
}
