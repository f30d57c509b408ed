//! Promises about masks: where they are found, how they combine, and how they are downscaled.

use std::path::Path;

use image::{GrayImage, Luma, Rgba, RgbaImage};
use tempfile::TempDir;

use super::test_capture::{SIZES, TestCapture};
use super::*;

/// First photo by name, of the size of the first camera.
const FIRST: &str = "view r.png";

fn good() -> TempDir {
    let root = TempDir::new().unwrap();
    let capture = TestCapture::new();
    capture.write_photos(root.path());
    capture.write_binary(&root.path().join("sparse/0"));
    root
}

fn load(root: &Path) -> Result<Capture, CaptureError> {
    Capture::load(root, &CaptureSettings::new())
}

/// Writes a mask of the size of the first photo.
fn mask(path: &Path, value: impl Fn(u32, u32) -> u8) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    let [w, h] = SIZES[0];
    let pixel = |x, y| Luma([value(x, y)]);
    GrayImage::from_fn(w, h, pixel).save(path).unwrap();
}

#[test]
fn masks_are_found_by_name() {
    let by_x = |x: u32, _: u32| 8 * x as u8;
    for (folder, images, name) in [
        ("masks", "images", "view r.png.png"),
        ("masks", "images", "view r.png"),
        ("masks_2", "images_2", "view r.png.png"),
        ("masks", "images_2", "view r.png.png"),
    ] {
        let root = good();
        if images != "images" {
            std::fs::rename(root.path().join("images"), root.path().join(images)).unwrap();
        }
        mask(&root.path().join(folder).join(name), by_x);
        let options = CaptureSettings::new().with_images(PathBuf::from(images));
        let capture = Capture::load(root.path(), &options).unwrap();
        assert_eq!(
            capture.views[0].mask.as_ref().unwrap()[..4],
            [0, 8, 16, 24],
            "{name}"
        );
        assert_eq!(capture.views[0].image[..3], [0, 0, 92]);
        assert!(capture.views[1..].iter().all(|view| view.mask.is_none()));
        let expected = CaptureWarning::PhotosWithoutMask {
            folder: root.path().join(folder),
            count: 8,
            photos: 9,
            first: "view s.png".into(),
        };
        assert_eq!(capture.warnings, [expected]);
    }
}

/// The convention `NAME.EXT.png` comes before `NAME.png`, which here is the photo's own name.
#[test]
fn the_convention_of_colmap_comes_first() {
    let root = good();
    mask(&root.path().join("masks/view r.png.png"), |_, _| 7);
    mask(&root.path().join("masks/view r.png"), |_, _| 9);
    let capture = load(root.path()).unwrap();
    assert_eq!(capture.views[0].mask.as_ref().unwrap()[0], 7);
}

#[test]
fn alpha_and_mask_are_multiplied() {
    let root = good();
    let pixel = |x: u32, y: u32| Rgba([x as u8, y as u8, 5, if y == 0 { 51 } else { 255 }]);
    let photo = RgbaImage::from_fn(32, 24, pixel);
    photo.save(root.path().join("images").join(FIRST)).unwrap();
    mask(&root.path().join("masks/view r.png.png"), |x, _| {
        8 * x as u8
    });
    let capture = load(root.path()).unwrap();
    let found = capture.views[0].mask.as_ref().unwrap();
    assert_eq!(found[..5], [0, 2, 3, 5, 6]);
    assert_eq!(found[32..37], [0, 8, 16, 24, 32]);
    // Colours stay.
    assert_eq!(capture.views[0].image[3..6], [1, 0, 5]);
    let [ref transparent, _] = capture.warnings[..] else {
        panic!("two warnings, not {:?}", capture.warnings);
    };
    assert!(transparent.to_string().contains("masked"), "{transparent}");
}

#[test]
fn a_mask_that_ignores_nothing_is_none() {
    let root = good();
    mask(&root.path().join("masks/view r.png.png"), |_, _| 255);
    assert_eq!(load(root.path()).unwrap().views[0].mask, None);
    // Some programs write 0 and 1.
    mask(&root.path().join("masks/view r.png.png"), |x, _| {
        u8::from(x > 1)
    });
    let capture = load(root.path()).unwrap();
    assert_eq!(
        capture.views[0].mask.as_ref().unwrap()[..4],
        [0, 0, 255, 255]
    );
}

#[test]
fn a_mask_that_ignores_all_is_told() {
    let root = good();
    mask(&root.path().join("masks/view r.png.png"), |_, _| 0);
    let capture = load(root.path()).unwrap();
    let expected = CaptureWarning::EmptyMasks {
        count: 1,
        first: FIRST.into(),
    };
    assert_eq!(capture.warnings[0], expected);
    assert!(
        capture.views[0]
            .mask
            .as_ref()
            .unwrap()
            .iter()
            .all(|&v| v == 0)
    );
}

#[test]
fn a_mask_of_another_size_is_refused() {
    let root = good();
    let path = root.path().join("masks/view r.png.png");
    mask(&path, |_, _| 0);
    GrayImage::new(31, 24).save(&path).unwrap();
    let message = load(root.path()).unwrap_err().to_string();
    for word in ["view r.png.png", "31x24", "images/view r.png is 32x24"] {
        assert!(message.contains(word), "{message}");
    }
    std::fs::write(&path, b"no picture").unwrap();
    let message = load(root.path()).unwrap_err().to_string();
    assert!(
        message.contains("view r.png.png: cannot be decoded"),
        "{message}"
    );
}

/// Ignored colours do not bleed into pixels that count.
#[test]
fn masks_are_downscaled_with_their_photos() {
    let picture = downscale::Picture {
        pixels: &[
            [10, 20, 30],
            [200, 200, 200],
            [1, 2, 3],
            [3, 2, 1],
            [30, 40, 50],
            [255, 0, 0],
            [5, 6, 7],
            [7, 6, 5],
        ]
        .concat(),
        mask: Some(&[255, 0, 0, 0, 255, 0, 0, 0]),
        width: 4,
        height: 2,
    };
    let (pixels, counts) = downscale::area_average(&picture, 2);
    // The left block counts by half, with the mean of what counts; nothing counts in the right one.
    assert_eq!(counts, Some(vec![128, 0]));
    assert_eq!(pixels, [20, 30, 40, 4, 4, 4]);

    let root = good();
    let value = |x: u32, y: u32| {
        if (x + y).is_multiple_of(3) {
            255
        } else {
            17 * y as u8 % 200
        }
    };
    mask(&root.path().join("masks/view r.png.png"), value);
    let full = load(root.path()).unwrap();
    let options = CaptureSettings::new().with_downscale(2);
    let half = Capture::load(root.path(), &options).unwrap();
    let (half, again) = (&half.views[0], full.views[0].downscaled(2));
    assert_eq!((&half.mask, &half.image), (&again.mask, &again.image));
    assert_eq!(half.mask.as_ref().unwrap().len(), 16 * 12);
}
