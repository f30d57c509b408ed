//! Promises about photos: each is complete or refused, wherever it is stored.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use image::{ImageFormat, RgbImage};
use tempfile::TempDir;

use super::test_capture::{SIZES, TestCapture, good, load};
use super::*;

/// First photo by name, of the size of the first camera.
const FIRST: &str = "view r.png";

const LOSSY_WEBP: &[u8] = include_bytes!("testdata/lossy.webp");

fn load_from(root: &Path, images: &Path) -> Result<Capture, CaptureError> {
    let options = CaptureSettings {
        images: Some(images.to_path_buf()),
        ..CaptureSettings::default()
    };
    Capture::load(root, &options)
}

/// A photo with unpredictable pixels, in a file of this format (whatever the file's name).
fn photo(format: ImageFormat) -> Vec<u8> {
    let [w, h] = SIZES[0];
    let noise = |x: u32, y: u32| [x * y * 7, x * x + 3 * y, x ^ (y * 11)].map(|v| v as u8);
    let photo = RgbImage::from_fn(w, h, |x, y| image::Rgb(noise(x, y)));
    let mut bytes = Cursor::new(Vec::new());
    photo.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

#[test]
fn a_part_of_a_photo_is_refused_by_name() {
    let (root, _) = good();
    let path = root.path().join("images").join(FIRST);
    let files = [
        (ImageFormat::Jpeg, photo(ImageFormat::Jpeg)),
        (ImageFormat::Png, photo(ImageFormat::Png)),
        (ImageFormat::WebP, photo(ImageFormat::WebP)),
        (ImageFormat::WebP, LOSSY_WEBP.to_vec()),
        (ImageFormat::Tiff, photo(ImageFormat::Tiff)),
    ];
    for (format, bytes) in files {
        std::fs::write(&path, &bytes).unwrap();
        let whole = load(root.path()).unwrap();
        assert_eq!(whole.warnings, []);
        let mut refused = 0;
        for until in 0..bytes.len() {
            std::fs::write(&path, &bytes[..until]).unwrap();
            match load(root.path()) {
                Ok(capture) => assert_eq!(
                    capture.views[0].image,
                    whole.views[0].image,
                    "{format:?} cut at {until} of {}",
                    bytes.len()
                ),
                Err(error) => {
                    let message = error.to_string();
                    assert!(
                        message.contains(FIRST) && !message.contains('\n'),
                        "{message}"
                    );
                    refused += 1;
                }
            }
        }
        // Everything except what follows the last pixel, which in TIFF is a directory.
        assert!(
            refused + 16 >= bytes.len(),
            "{format:?}: {refused} of {}",
            bytes.len()
        );
    }
}

/// The same picture in many kinds of files, see `testdata/generate.py`.
#[test]
fn photos_of_every_kind_are_read() {
    let (root, _) = good();
    let path = root.path().join("images").join(FIRST);
    let colors = [[255, 255, 255], [200, 40, 30], [20, 60, 180], [0, 0, 0]];
    let black_and_white = [[255; 3], [0; 3], [0; 3], [0; 3]];
    let kinds: [(&str, &[u8]); 12] = [
        ("cmyk_adobe.jpg", include_bytes!("testdata/cmyk_adobe.jpg")),
        ("ycck_adobe.jpg", include_bytes!("testdata/ycck_adobe.jpg")),
        ("palette.png", include_bytes!("testdata/palette.png")),
        (
            "palette_transparent.png",
            include_bytes!("testdata/palette_transparent.png"),
        ),
        ("bilevel.png", include_bytes!("testdata/bilevel.png")),
        ("lossy.webp", LOSSY_WEBP),
        (
            "lossy_alpha.webp",
            include_bytes!("testdata/lossy_alpha.webp"),
        ),
        ("lossless.webp", include_bytes!("testdata/lossless.webp")),
        ("lzw.tiff", include_bytes!("testdata/lzw.tiff")),
        ("deflate.tiff", include_bytes!("testdata/deflate.tiff")),
        ("jpeg.tiff", include_bytes!("testdata/jpeg.tiff")),
        ("cmyk.tiff", include_bytes!("testdata/cmyk.tiff")),
    ];
    for (name, bytes) in kinds {
        std::fs::write(&path, bytes).unwrap();
        let view = &load(root.path()).unwrap().views[0];
        let expected = match name {
            "bilevel.png" => black_and_white,
            _ => colors,
        };
        let places = [(5, 5), (25, 5), (5, 20), (25, 20)].map(|(x, y)| 32 * y + x);
        for (at, expected) in places.iter().zip(expected) {
            let found = &view.image[3 * at..3 * at + 3];
            let off = found.iter().zip(expected).map(|(a, b)| a.abs_diff(b));
            assert!(off.max() <= Some(2), "{name}: {found:?} for {expected:?}");
        }
        let counts = |at: &usize| view.mask.as_ref().map(|mask| mask[*at]);
        let masks = match name {
            "palette_transparent.png" => [0, 255, 255, 255].map(Some),
            "lossy_alpha.webp" => [255, 128, 0, 255].map(Some),
            _ => [None; 4],
        };
        assert_eq!(places.each_ref().map(counts), masks, "{name}");
    }
}

/// Grey and colour, with and without alpha, of 8 and 16 bits, which are rounded to the nearest.
#[test]
fn values_of_sixteen_bits_are_rounded() {
    let (root, _) = good();
    let path = root.path().join("images").join(FIRST);
    let [w, h] = SIZES[0];
    let value = |x: u32, y: u32| (x * 2111 + y * 1373) as u16;
    let narrow = |value: u16| (f64::from(value) * 255.0 / 65_535.0).round() as u8;
    let at = |x: u32, y: u32| (y * w + x) as usize;
    let check = |photo: image::DynamicImage, colored: bool, alpha: bool| {
        for format in [ImageFormat::Png, ImageFormat::Tiff] {
            // The encoder of TIFF knows no grey with alpha.
            if format == ImageFormat::Tiff && alpha && !colored {
                continue;
            }
            photo.save_with_format(&path, format).unwrap();
            let view = &load(root.path()).unwrap().views[0];
            for (x, y) in [(0, 0), (1, 0), (7, 5), (31, 23), (16, 20)] {
                let first = narrow(value(x, y));
                let second = if colored {
                    narrow(value(x, y) / 2)
                } else {
                    first
                };
                let found = &view.image[3 * at(x, y)..][..3];
                assert_eq!(found, [first, second, first], "{format:?}");
                let mask = view.mask.as_ref().map(|mask| mask[at(x, y)]);
                assert_eq!(mask, alpha.then(|| narrow(!value(x, y))), "{format:?}");
            }
        }
    };
    let rgb = |x, y| [value(x, y), value(x, y) / 2, value(x, y)];
    let grey = image::ImageBuffer::from_fn(w, h, |x, y| image::Luma([value(x, y)]));
    check(grey.into(), false, false);
    let with_alpha = |x, y| image::LumaA([value(x, y), !value(x, y)]);
    let grey = image::ImageBuffer::from_fn(w, h, with_alpha);
    check(grey.into(), false, true);
    let color = image::ImageBuffer::from_fn(w, h, |x, y| image::Rgb(rgb(x, y)));
    check(color.into(), true, false);
    let with_alpha = |x, y| {
        let [r, g, b] = rgb(x, y);
        image::Rgba([r, g, b, !value(x, y)])
    };
    let color = image::ImageBuffer::from_fn(w, h, with_alpha);
    check(color.into(), true, true);
    let eight = image::GrayImage::from_fn(w, h, |x, y| image::Luma([narrow(value(x, y))]));
    check(eight.into(), false, false);
}

#[test]
fn a_photo_with_too_much_in_it_is_told() {
    let (root, _) = good();
    let path = root.path().join("images").join(FIRST);
    let mut bytes = photo(ImageFormat::Jpeg);
    let header = bytes
        .windows(2)
        .position(|pair| pair == [0xff, 0xc0])
        .unwrap();
    assert_eq!(bytes[header + 5..header + 9], [0, 24, 0, 32]);
    // Half the width and height in the header.
    bytes[header + 6] = 12;
    bytes[header + 8] = 16;
    std::fs::write(&path, bytes).unwrap();
    let warnings = load(root.path()).unwrap().warnings;
    let is_damaged = |warning: &CaptureWarning| match warning {
        CaptureWarning::DamagedPhotos { count: 1, first } => first == FIRST,
        _ => false,
    };
    assert!(warnings.iter().any(is_damaged), "{warnings:?}");
}

#[test]
fn photos_are_read_from_the_folder_that_is_named() {
    let (root, _) = good();
    let usual = load(root.path()).unwrap();
    let moved = root.path().join("images_4");
    std::fs::rename(root.path().join("images"), &moved).unwrap();
    for folder in [
        "images_4".into(),
        moved.clone(),
        PathBuf::from("./images_4/"),
    ] {
        let capture = load_from(root.path(), &folder).unwrap();
        assert_eq!(capture.warnings, []);
        let pixels = |capture: &Capture| -> Vec<_> {
            capture
                .views
                .iter()
                .map(|view| view.image.clone())
                .collect()
        };
        assert_eq!(pixels(&capture), pixels(&usual));
        assert_eq!(capture.views[0].name, FIRST);
    }
    // And from any other directory.
    let elsewhere = TempDir::new().unwrap();
    let elsewhere = elsewhere.path().join("photos");
    std::fs::create_dir_all(&elsewhere).unwrap();
    for entry in std::fs::read_dir(&moved).unwrap() {
        let entry = entry.unwrap();
        std::fs::copy(entry.path(), elsewhere.join(entry.file_name())).unwrap();
    }
    load_from(root.path(), &elsewhere).unwrap();
}

#[test]
fn another_folder_with_the_photos_is_suggested() {
    let (root, _) = good();
    let images = root.path().join("images");
    std::fs::rename(&images, root.path().join("images_2")).unwrap();
    let suggested = |error: CaptureError| {
        let message = error.to_string();
        assert!(
            message.contains("--images") && message.contains("`images_2`"),
            "{message}"
        );
        assert!(!message.contains('\n'), "{message}");
        message
    };
    // No folder of the usual name, an empty one, and one with a few photos.
    suggested(load(root.path()).unwrap_err());
    std::fs::create_dir(&images).unwrap();
    suggested(load(root.path()).unwrap_err());
    std::fs::copy(root.path().join("images_2").join(FIRST), images.join(FIRST)).unwrap();
    let message = suggested(load(root.path()).unwrap_err());
    assert!(message.contains("9 photo(s)"), "{message}");

    let message = suggested(load_from(root.path(), "nowhere".as_ref()).unwrap_err());
    assert!(message.contains("nowhere"), "{message}");

    // Photos beside the model.
    std::fs::remove_dir_all(&images).unwrap();
    std::fs::create_dir(&images).unwrap();
    for entry in std::fs::read_dir(root.path().join("images_2")).unwrap() {
        let entry = entry.unwrap();
        std::fs::rename(entry.path(), root.path().join(entry.file_name())).unwrap();
    }
    let message = load(root.path()).unwrap_err().to_string();
    assert!(message.contains("the folder `.`"), "{message}");
    load_from(root.path(), ".".as_ref()).unwrap();

    // Nothing is suggested that does not exist.
    let bare = TempDir::new().unwrap();
    TestCapture::new().write_binary(&bare.path().join("sparse/0"));
    let message = load(bare.path()).unwrap_err().to_string();
    assert!(!message.contains("--images"), "{message}");
}

/// The first photo that the model does not name, and the number of such photos.
fn left_out(root: &Path) -> Option<(String, usize)> {
    load(root)
        .unwrap()
        .warnings
        .into_iter()
        .find_map(|warning| match warning {
            CaptureWarning::UnregisteredPhotos { first, count } => Some((first, count)),
            _ => None,
        })
}

#[test]
fn photos_that_the_model_does_not_name_are_counted_in_sub_folders_too() {
    let (root, mut model) = good();
    let images = root.path().join("images");
    // Masks beside a model with photos in one folder are not photos of it.
    std::fs::create_dir(images.join("masks")).unwrap();
    std::fs::write(images.join("masks/a.png"), []).unwrap();
    assert_eq!(left_out(root.path()), None);
    for name in ["b.TIF", "a.png", "._a.png", "notes.txt"] {
        std::fs::write(images.join(name), []).unwrap();
    }
    assert_eq!(left_out(root.path()), Some(("a.png".to_owned(), 2)));

    // In a rig with a folder per camera, one camera may be missing.
    std::fs::remove_dir_all(&images).unwrap();
    for (_, _, _, camera, name) in &mut model.images {
        let folder = format!("cam{camera}");
        std::fs::create_dir_all(images.join(&folder)).unwrap();
        *name = format!("{folder}/{name}");
    }
    model.write_photos(root.path());
    model.write_binary(&root.path().join("sparse/0"));
    assert_eq!(left_out(root.path()), None);
    for name in ["cam7/z.jpg", "cam8/b/z.jpg", "cam8/.thumbnails/z.jpg"] {
        let path = images.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, []).unwrap();
    }
    assert_eq!(left_out(root.path()), Some(("cam7/z.jpg".to_owned(), 2)));
}
