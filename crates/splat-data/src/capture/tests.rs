//! Promises of the readers: both encodings give the same model, the geometry is preserved, and bad
//! input is an error that names the file, never a panic.

use std::path::{Path, PathBuf};

use tempfile::TempDir;

use super::test_capture::{SIZES, TestCapture, good, load};
use super::*;

/// The error of loading `root`, which must be one line and name `file`.
fn error_of(root: &Path, file: &str) -> CaptureError {
    let error = load(root).expect_err("the capture is bad");
    let message = error.to_string();
    assert!(message.contains(file), "`{message}` does not name {file}");
    assert!(!message.contains('\n'), "`{message}` is not one line");
    error
}

/// The example that ships with the project.
fn example() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/data/saharov")
}

#[test]
fn text_and_binary_are_the_same_model() {
    let root = TempDir::new().unwrap();
    let model = TestCapture::new();
    model.write_binary(&root.path().join("sparse/0"));
    let (binary, _) = colmap::read(root.path(), &CaptureSettings::new()).unwrap();
    std::fs::remove_dir_all(root.path().join("sparse")).unwrap();
    model.write_text(&root.path().join("sparse"));
    let (text, _) = colmap::read(root.path(), &CaptureSettings::new()).unwrap();
    assert_eq!(binary, text);

    assert_eq!(binary.images.len(), 9);
    assert_eq!(binary.images[0].name, "view r.png");
    assert_eq!(binary.images[0].id, 92);
    assert_eq!(binary.images[0].camera_id, 7);
    let pixels = sparse_model::Intrinsics::Pixels {
        size: SIZES[1],
        values: [33.0, 33.0, 12.0, 15.0],
    };
    assert_eq!(binary.cameras[&2].intrinsics, pixels);
    assert_eq!(binary.points[3].color, [3, 255, 30]);
    assert_eq!(binary.points[3].position, [1.0, -3e-7, 1e6 - 3.0]);
}

#[test]
fn the_example_is_the_same_as_text() {
    let file = |name: &str| {
        let path = example().join("sparse/0").join(name);
        (std::fs::read(&path).unwrap(), path)
    };
    let (cameras, path) = file("cameras.bin");
    let cameras = colmap_binary::parse_cameras(&path, &cameras).unwrap();
    let (images, path) = file("images.bin");
    let images = colmap_binary::parse_images(&path, &images, false).unwrap();
    let (binary, _) = colmap::read(&example(), &CaptureSettings::new()).unwrap();
    let text = TestCapture {
        cameras: cameras
            .iter()
            .map(|c| {
                (
                    c.id,
                    1,
                    c.width.into(),
                    c.height.into(),
                    c.intrinsics.to_vec(),
                )
            })
            .collect(),
        images: images
            .into_iter()
            .map(|i| (i.id, i.quaternion, i.translation, i.camera_id, i.name))
            .collect(),
        points: (0..).zip(binary.points.iter().copied()).collect(),
    };
    let root = TempDir::new().unwrap();
    text.write_text(&root.path().join("sparse/0"));
    let (text, _) = colmap::read(root.path(), &CaptureSettings::new()).unwrap();
    assert_eq!(binary, text);
}

#[test]
fn keypoints_are_read_if_asked_for() {
    let (root, model) = good();
    let settings = CaptureSettings::new().with_observations(true);
    let read = |settings: &CaptureSettings| Capture::load(root.path(), settings).unwrap();
    assert_eq!(read(&CaptureSettings::new()).observations, []);
    let binary = read(&settings);
    // Every second image in the order of the file, whose names are in reverse order.
    let views: Vec<u32> = binary.observations.iter().map(|o| o.view).collect();
    assert_eq!(views, [0, 2, 4, 6, 8]);
    assert!(binary.observations.iter().all(|o| o.point == 3));
    for observation in &binary.observations {
        let [fx, fy, cx, cy] = binary.views[observation.view as usize].intrinsics;
        let [x, y] = observation.position;
        let pixel = [fx * x + cx, fy * y + cy];
        assert!(
            (pixel[0] - 3.0).abs() < 1e-12 && (pixel[1] - 4.0).abs() < 1e-12,
            "{pixel:?}"
        );
    }
    // Photos of half the size: the same places in the image plane.
    let half = read(&settings.clone().with_downscale(2));
    assert_eq!(half.observations, binary.observations);

    std::fs::remove_dir_all(root.path().join("sparse")).unwrap();
    model.write_text(&root.path().join("sparse"));
    assert_eq!(read(&settings).observations, binary.observations);
}

#[test]
fn ids_that_say_nothing_are_named() {
    let settings = CaptureSettings::new().with_observations(true);
    let problem = |root: &Path| {
        assert!(load(root).is_ok());
        let error = Capture::load(root, &settings).unwrap_err();
        error.to_string()
    };
    let (root, mut model) = good();
    model.points[1].0 = model.points[4].0;
    model.write_binary(&root.path().join("sparse/0"));
    let message = problem(root.path());
    let id = model.points[4].0.to_string();
    assert!(
        message.contains("points3D.bin") && message.contains(&id),
        "{message}"
    );

    let (root, model) = good();
    std::fs::remove_dir_all(root.path().join("sparse")).unwrap();
    let folder = root.path().join("sparse");
    model.write_text(&folder);
    let images = std::fs::read_to_string(folder.join("images.txt")).unwrap();
    std::fs::write(folder.join("images.txt"), images.replace("12.0", "12.5")).unwrap();
    let message = problem(root.path());
    assert!(
        message.contains("line 3") && message.contains("`12.5`"),
        "{message}"
    );
}

#[test]
fn a_keypoint_at_infinity_is_named() {
    let (root, model) = good();
    let mut images = model.images_bin();
    let at = images.len() - 3 * 24 + 24;
    images[at..at + 8].copy_from_slice(&f64::INFINITY.to_le_bytes());
    std::fs::write(root.path().join("sparse/0/images.bin"), images).unwrap();
    assert!(load(root.path()).is_ok());
    let settings = CaptureSettings::new().with_observations(true);
    let message = Capture::load(root.path(), &settings)
        .unwrap_err()
        .to_string();
    for word in ["images.bin", "view r.png", "keypoint 0"] {
        assert!(message.contains(word), "{message}");
    }
}

#[test]
fn the_example_sees_its_points() {
    let capture = load(&example()).unwrap();
    assert_eq!(capture.name, "saharov");
    assert_eq!((capture.views.len(), capture.split.test.len()), (32, 4));
    assert_eq!(capture.warnings, []);
    let count = capture.points.len();
    for view in &capture.views {
        assert_eq!(
            view.image.len(),
            3 * view.width as usize * view.height as usize
        );
        let inside = |point: &&Point| {
            let Some(([x, y], _)) = view.project(point.position) else {
                return false;
            };
            let (w, h) = (f64::from(view.width), f64::from(view.height));
            (0.0..w).contains(&x) && (0.0..h).contains(&y)
        };
        let seen = capture.points.iter().filter(inside).count();
        assert!(
            seen > count / 2,
            "{} sees {seen} of {count} points",
            view.name
        );
    }
}

#[test]
fn quaternions_are_normalised_and_poses_kept() {
    let (root, capture) = good();
    let views = load(root.path()).unwrap().views;
    for view in &views {
        let m = view.viewmat;
        let dot = |a: usize, b: usize| (0..3).map(|i| m[a][i] * m[b][i]).sum::<f64>();
        for (a, b) in [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)] {
            let expected = f64::from(u8::from(a == b));
            assert!((dot(a, b) - expected).abs() < 1e-15);
        }
        let (_, _, translation, _, _) = capture
            .images
            .iter()
            .find(|image| image.4 == view.name)
            .unwrap();
        assert_eq!([m[0][3], m[1][3], m[2][3]], *translation);
        // The centre is the point that the camera maps to its origin.
        let center = view.camera().position().to_array();
        for row in &m[..3] {
            let mapped = row[0] * center[0] + row[1] * center[1] + row[2] * center[2] + row[3];
            assert!(mapped.abs() < 1e-14);
        }
    }
    // A rotation about y by twice 0.3, in COLMAP's convention.
    let second = views.iter().find(|view| view.name == "view y.png").unwrap();
    assert!((second.viewmat[0][2] - 0.6f64.sin()).abs() < 1e-15);
    assert!((second.viewmat[2][0] + 0.6f64.sin()).abs() < 1e-15);
}

#[test]
fn photos_are_kept_as_they_are() {
    let (root, _) = good();
    let capture = load(root.path()).unwrap();
    assert_eq!(capture.warnings, []);
    let view = &capture.views[0];
    assert_eq!([view.width, view.height], SIZES[0]);
    // Pixel (x, y) was written as (x, y, id).
    let at = 3 * (5 * view.width as usize + 9);
    assert_eq!(view.image[at..at + 3], [9, 5, 92]);
}

#[test]
fn downscale_averages_areas_and_divides_intrinsics() {
    let (root, _) = good();
    let full = load(root.path()).unwrap();
    let half = Capture::load(
        root.path(),
        &CaptureSettings {
            downscale: 2,
            ..CaptureSettings::default()
        },
    )
    .unwrap();
    for (full, half) in full.views.iter().zip(&half.views) {
        assert_eq!([half.width, half.height], [full.width / 2, full.height / 2]);
        assert_eq!(half.intrinsics, full.intrinsics.map(|value| value / 2.0));
        let w = full.width as usize;
        let [x, y] = [6, 3];
        for channel in 0..3 {
            let value =
                |dx, dy| f64::from(full.image[3 * ((2 * y + dy) * w + 2 * x + dx) + channel]);
            let mean = (value(0, 0) + value(1, 0) + value(0, 1) + value(1, 1)) / 4.0;
            let got = half.image[3 * (y * half.width as usize + x) + channel];
            assert_eq!(f64::from(got), mean.round());
        }
    }

    // Pixels that do not fill a block are dropped: 7 x 5 by 3 is 2 x 1.
    let image: Vec<u8> = (0..7 * 5).flat_map(|i| [i, 0, 255]).collect();
    let picture = downscale::Picture {
        pixels: &image,
        mask: None,
        width: 7,
        height: 5,
    };
    let (pixels, mask) = downscale::area_average(&picture, 3);
    assert_eq!(mask, None);
    assert_eq!(pixels, [8, 0, 255, 11, 0, 255]);

    let none = CaptureSettings {
        downscale: 0,
        ..CaptureSettings::default()
    };
    assert!(matches!(
        Capture::load(root.path(), &none),
        Err(CaptureError::ZeroDownscale)
    ));
    let much = CaptureSettings {
        downscale: 3,
        ..CaptureSettings::default()
    };
    let error = Capture::load(root.path(), &much).unwrap_err();
    assert!(matches!(error, CaptureError::PhotoTooSmall { .. }));
}

#[test]
fn rescaled_photos_take_their_intrinsics_along() {
    let (root, _) = good();
    let name = "view r.png";
    let path = root.path().join("images").join(name);
    // 32 x 24 by 0.7 is 22.4 x 16.8.
    image::RgbImage::new(22, 17).save(&path).unwrap();
    let capture = load(root.path()).unwrap();
    let view = &capture.views[0];
    let (sx, sy) = (22.0 / 32.0, 17.0 / 24.0);
    assert_eq!(
        view.intrinsics,
        [40.5 * sx, 41.25 * sy, 15.75 * sx, 12.5 * sy]
    );
    let [warning] = &capture.warnings[..] else {
        panic!("one warning, not {:?}", capture.warnings);
    };
    assert!(warning.to_string().contains(name));

    // A different aspect ratio is not a rescale.
    for (w, h, word) in [(22, 22, "uniform"), (24, 32, "rotated"), (1, 1, "11x11")] {
        image::RgbImage::new(w, h).save(&path).unwrap();
        assert!(error_of(root.path(), name).to_string().contains(word));
    }
}

#[test]
fn transparent_pixels_are_masked_and_keep_their_colour() {
    let (root, _) = good();
    let pixel = |x: u32, _| image::Rgba([200, 100, 50, if x == 0 { 128 } else { 255 }]);
    image::RgbaImage::from_fn(32, 24, pixel)
        .save(root.path().join("images/view r.png"))
        .unwrap();
    let capture = load(root.path()).unwrap();
    let view = &capture.views[0];
    assert_eq!(view.image[..6], [200, 100, 50, 200, 100, 50]);
    assert_eq!(view.mask.as_ref().unwrap()[..3], [128, 255, 255]);
    assert_eq!(capture.views[1].mask, None);
    let [CaptureWarning::TransparentPhotos { count: 1, .. }] = capture.warnings[..] else {
        panic!("a warning, not {:?}", capture.warnings);
    };
}

#[test]
fn files_that_are_not_needed_do_no_harm() {
    let (root, _) = good();
    for file in ["rigs.bin", "frames.bin", "project.ini"] {
        std::fs::write(root.path().join("sparse/0").join(file), b"anything").unwrap();
    }
    std::fs::write(root.path().join("images/extra.JPG"), b"no photo").unwrap();
    std::fs::create_dir(root.path().join("sparse/1")).unwrap();
    std::fs::write(root.path().join("sparse/1/cameras.bin"), b"").unwrap();
    let warnings = load(root.path()).unwrap().warnings;
    assert!(matches!(
        &warnings[..],
        [
            CaptureWarning::DamagedModels { count: 1, .. },
            CaptureWarning::UnregisteredPhotos { count: 1, first }
        ] if first == "extra.JPG"
    ));
}

#[test]
fn what_follows_the_last_record_is_an_error() {
    let (root, model) = good();
    let folder = root.path().join("sparse/0");
    for (file, bytes, count) in [
        ("cameras.bin", model.cameras_bin(), "2 cameras"),
        ("images.bin", model.images_bin(), "9 images"),
        ("points3D.bin", model.points_bin(), "5 points"),
    ] {
        for more in [&[0][..], b"0123456"] {
            std::fs::write(folder.join(file), [&bytes, more].concat()).unwrap();
            let message = error_of(root.path(), file).to_string();
            let bytes = format!("{} bytes", more.len());
            assert!(
                message.contains(&bytes) && message.contains(count),
                "{message}"
            );
        }
        std::fs::write(folder.join(file), bytes).unwrap();
    }
    load(root.path()).unwrap();
}

#[test]
fn a_wrong_count_is_told() {
    let (root, model) = good();
    let folder = root.path().join("sparse/0");
    std::fs::remove_dir_all(&folder).unwrap();
    model.write_text(&folder);
    assert_eq!(load(root.path()).unwrap().warnings, []);
    let counts = [("cameras", 2, 3), ("images", 9, 15), ("points3D", 5, 4)];
    for (stem, read, announced) in counts {
        let path = folder.join(format!("{stem}.txt"));
        let text = std::fs::read_to_string(&path).unwrap();
        let what = stem.trim_end_matches("3D");
        for count in [read, announced] {
            let head = format!("\u{feff}# Number of {what}: {count}, mean of something: 2.5\r\n");
            std::fs::write(&path, head + &text).unwrap();
            let warnings = load(root.path()).unwrap().warnings;
            let messages: Vec<String> = warnings.iter().map(ToString::to_string).collect();
            assert_eq!(messages.len(), usize::from(count != read), "{messages:?}");
            for message in messages {
                let says = |word: &str| assert!(message.contains(word), "{message}");
                says(&format!("{stem}.txt"));
                says(&format!("{announced} {what}"));
                says(&format!("lists {read}"));
            }
        }
        std::fs::write(&path, text).unwrap();
    }
}

#[test]
fn every_truncation_is_an_error() {
    let (root, model) = good();
    let files = [
        ("cameras.bin", model.cameras_bin()),
        ("images.bin", model.images_bin()),
        ("points3D.bin", model.points_bin()),
    ];
    for (file, bytes) in &files {
        let path = root.path().join("sparse/0").join(file);
        for end in 0..bytes.len() {
            std::fs::write(&path, &bytes[..end]).unwrap();
            let error = error_of(root.path(), file);
            assert!(
                matches!(
                    error,
                    CaptureError::Truncated { .. } | CaptureError::ImpossibleCount { .. }
                ),
                "{file} cut at {end}: {error}"
            );
        }
        std::fs::write(&path, bytes).unwrap();
    }
    load(root.path()).unwrap();
}

#[test]
fn garbage_is_an_error() {
    let (root, model) = good();
    let good_files = [
        ("cameras.bin", model.cameras_bin()),
        ("images.bin", model.images_bin()),
        ("points3D.bin", model.points_bin()),
    ];
    for (file, bytes) in &good_files {
        let path = root.path().join("sparse/0").join(file);
        // A count that would need more memory than there is, and noise.
        let mut huge = bytes.clone();
        huge[..8].fill(0xff);
        let mut state = 1u32;
        let noise: Vec<u8> = (0..999)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 24) as u8
            })
            .collect();
        for bad in [huge, noise] {
            std::fs::write(&path, bad).unwrap();
            error_of(root.path(), file);
        }
        std::fs::write(&path, bytes).unwrap();
    }
}

#[test]
fn other_camera_models_are_named() {
    let (root, mut model) = good();
    for (number, name) in [
        (7, "FOV (number 7)"),
        (10, "THIN_PRISM_FISHEYE (number 10)"),
        (17, "EQUIRECTANGULAR (number 17)"),
        (99, "number 99"),
    ] {
        model.cameras[1].1 = number;
        model.write_binary(&root.path().join("sparse/0"));
        let error = error_of(root.path(), "cameras.bin");
        assert!(matches!(
            &error,
            CaptureError::UnsupportedCamera { camera_id: 2, model, .. } if model == name
        ));
        let help = if number == 17 {
            "perspective views"
        } else {
            "image_undistorter"
        };
        let message = error.to_string();
        assert!(
            message.contains(name) && message.contains(help),
            "{message}"
        );
    }
    model.cameras[1].1 = 7;
    std::fs::remove_dir_all(root.path().join("sparse")).unwrap();
    model.write_text(&root.path().join("sparse/0"));
    let message = error_of(root.path(), "cameras.txt").to_string();
    assert!(message.contains("camera 2") && message.contains("FOV"));
}

/// Every model that is read, in both encodings.
#[test]
fn lenses_are_read() {
    let opencv = |k: [f64; 4]| Lens::OpenCv([k[0], k[1], k[2], k[3], 0.0, 0.0, 0.0, 0.0]);
    let cases = [
        (
            2,
            vec![33.0, 12.0, 15.0, -0.1],
            opencv([-0.1, 0.0, 0.0, 0.0]),
        ),
        (2, vec![33.0, 12.0, 15.0, 0.0], Lens::Pinhole),
        (
            3,
            vec![33.0, 12.0, 15.0, -0.1, 0.01],
            opencv([-0.1, 0.01, 0.0, 0.0]),
        ),
        (
            4,
            vec![33.0, 34.0, 12.0, 15.0, -0.1, 0.01, 1e-3, 2e-3],
            opencv([-0.1, 0.01, 1e-3, 2e-3]),
        ),
        (
            5,
            vec![33.0, 34.0, 12.0, 15.0, -0.1, 0.01, 1e-3, 2e-3],
            Lens::OpenCvFisheye([-0.1, 0.01, 1e-3, 2e-3]),
        ),
        (
            6,
            vec![
                33.0, 34.0, 12.0, 15.0, 0.1, 0.2, 1e-3, 2e-3, 0.3, 0.4, 0.5, 0.6,
            ],
            Lens::OpenCv([0.1, 0.2, 1e-3, 2e-3, 0.3, 0.4, 0.5, 0.6]),
        ),
        (
            8,
            vec![33.0, 12.0, 15.0, 0.1],
            Lens::OpenCvFisheye([0.1, 0.0, 0.0, 0.0]),
        ),
        (
            9,
            vec![33.0, 12.0, 15.0, 0.1, 0.2],
            Lens::OpenCvFisheye([0.1, 0.2, 0.0, 0.0]),
        ),
        (14, vec![33.0, 12.0, 15.0], Lens::OpenCvFisheye([0.0; 4])),
        (
            15,
            vec![33.0, 34.0, 12.0, 15.0],
            Lens::OpenCvFisheye([0.0; 4]),
        ),
    ];
    for (number, parameters, lens) in cases {
        let (root, mut model) = good();
        model.cameras[1].1 = number;
        model.cameras[1].4 = parameters.clone();
        let fy = parameters[usize::from([4, 5, 6, 15].contains(&number))];
        for text in [false, true] {
            let folder = root.path().join("sparse/0");
            std::fs::remove_dir_all(&folder).unwrap();
            if text {
                model.write_text(&folder);
            } else {
                model.write_binary(&folder);
            }
            let capture = load(root.path()).unwrap();
            let odd = |view: &&View| view.width == SIZES[1][0];
            let view = capture.views.iter().find(odd).unwrap();
            assert_eq!(view.lens, lens);
            assert_eq!(view.camera().lens, lens);
            assert_eq!(view.intrinsics, [33.0, fy, 12.0, 15.0]);
            let other = capture.views.iter().find(|view| !odd(view)).unwrap();
            assert_eq!(other.lens, Lens::Pinhole);
            assert_eq!(capture.warnings, []);
        }
    }
    let message = message_after("cameras.bin", |model| {
        model.cameras[0].1 = 4;
        model.cameras[0].4.extend([0.0, 0.0, f64::NAN, 0.0]);
    });
    assert!(
        message.contains("camera 7: its distortion coefficient p1 is NaN"),
        "{message}"
    );
}

/// A lens that folds back at a radius of 0.58, where a pixel of the photo would be at 0.77 of the
/// focal length.
#[test]
fn a_lens_that_ends_inside_of_the_photo_is_named() {
    let (root, mut model) = good();
    model.cameras[1].1 = 2;
    model.cameras[1].4 = vec![25.0, 12.0, 15.0, -1.0];
    model.write_binary(&root.path().join("sparse/0"));
    let capture = load(root.path()).unwrap();
    let [
        CaptureWarning::LensFoldsBack {
            count: 3,
            ref first,
            share,
        },
    ] = capture.warnings[..]
    else {
        panic!("a warning, not {:?}", capture.warnings);
    };
    // The lens reaches 0.385 focal lengths, or 9.6 pixels: a disk of 290 in 24 x 30.
    assert!((share - (1.0 - 290.0 / 720.0)).abs() < 0.05, "{share}");
    let message = capture.warnings[0].to_string();
    assert!(
        first == "view t.png" && message.contains(first) && message.contains("border"),
        "{message}"
    );
}

/// COLMAP writes every part of a reconstruction to a folder of its own.
#[test]
fn the_model_with_the_most_images_is_read() {
    for text in [false, true] {
        let (root, mut model) = good();
        let sparse = root.path().join("sparse");
        let write = |model: &TestCapture, name: &str| {
            if text {
                model.write_text(&sparse.join(name));
            } else {
                model.write_binary(&sparse.join(name));
            }
        };
        std::fs::remove_dir_all(sparse.join("0")).unwrap();
        write(&model, "10");
        model.images.truncate(3);
        write(&model, "0");
        model.images.truncate(2);
        write(&model, "2");
        let capture = load(root.path()).unwrap();
        assert_eq!(capture.views.len(), 9);
        let expected = CaptureWarning::OtherModels {
            used: sparse.join("10"),
            images: 9,
            others: 2,
        };
        assert_eq!(capture.warnings[..1], [expected]);
        let message = capture.warnings[0].to_string();
        assert!(message.contains("(9) of 3"), "{message}");

        // An impossible count is no reason.
        std::fs::remove_dir_all(sparse.join("2")).unwrap();
        model.write_binary(&sparse.join("2"));
        std::fs::write(sparse.join("2/images.bin"), [0xff; 80]).unwrap();
        assert_eq!(load(root.path()).unwrap().views.len(), 9);
    }
}

#[test]
fn a_capture_without_points_gets_random_ones() {
    let (root, mut model) = good();
    model.points.clear();
    model.write_binary(&root.path().join("sparse/0"));
    let empty = load(root.path()).unwrap();
    assert_eq!(empty.points.len(), 100_000);
    let [CaptureWarning::RandomPoints { count: 100_000, .. }] = empty.warnings[..] else {
        panic!("a warning, not {:?}", empty.warnings);
    };
    std::fs::remove_file(root.path().join("sparse/0/points3D.bin")).unwrap();
    let missing = load(root.path()).unwrap();
    assert_eq!(missing.points, empty.points);
    assert_eq!(missing.warnings, empty.warnings);
    assert_eq!(missing.background, None);
}

/// Breaks one thing in the valid model and returns the error message, which must name `file`.
fn message_after(file: &str, spoil: impl FnOnce(&mut TestCapture)) -> String {
    let (root, mut model) = good();
    spoil(&mut model);
    model.write_binary(&root.path().join("sparse/0"));
    error_of(root.path(), file).to_string()
}

#[test]
fn nonsense_in_a_record_is_named() {
    type Case = (&'static str, &'static str, fn(&mut TestCapture));
    let cases: [Case; 12] = [
        ("points3D.bin", "point 3", |m| {
            m.points[3].1.position[1] = f64::INFINITY;
        }),
        ("images.bin", "no image", |m| m.images.clear()),
        ("images.bin", "image 98", |m| m.images[2].2[0] = f64::NAN),
        ("images.bin", "image 98", |m| m.images[2].1[3] = f64::NAN),
        ("images.bin", "image 98", |m| m.images[2].1 = [0.0; 4]),
        ("images.bin", "camera 55", |m| m.images[2].3 = 55),
        ("images.bin", "twice", |m| {
            m.images[2].4 = m.images[1].4.clone();
        }),
        ("images.bin", r"a\nb", |m| m.images[2].4 = "a\nb".into()),
        ("cameras.bin", "twice", |m| m.cameras[1].0 = 7),
        ("cameras.bin", "camera 7", |m| m.cameras[0].2 = 0),
        ("cameras.bin", "height", |m| m.cameras[0].3 = u64::MAX),
        ("cameras.bin", "fx NaN", |m| m.cameras[0].4[0] = f64::NAN),
    ];
    for (file, word, spoil) in cases {
        let message = message_after(file, spoil);
        assert!(message.contains(word), "`{message}` does not say `{word}`");
    }
}

#[test]
fn bad_text_names_the_line() {
    let root = TempDir::new().unwrap();
    let folder = root.path().join("sparse/0");
    let model = TestCapture::new();
    let cases = [
        (
            "cameras.txt",
            "7 PINHOLE 32 24 40.5 41.25 15.75\n",
            "line 1",
        ),
        ("cameras.txt", "# hi\n7 PINHOLE 32 -24 1 1 1 1\n", "line 2"),
        ("images.txt", "1 1 0 0 0 0 0 x 7 a.png\n\n", "line 1"),
        ("images.txt", "1 1 0 0 0 0 0 0 7 \n\n", "name"),
        ("points3D.txt", "1 0 0 0 1 2 300 0.5\n", "colour"),
    ];
    for (file, text, word) in cases {
        model.write_text(&folder);
        std::fs::write(folder.join(file), text).unwrap();
        let message = error_of(root.path(), file).to_string();
        assert!(message.contains(word), "`{message}` does not say `{word}`");
    }
}

#[test]
fn missing_files_are_named() {
    let (root, _) = good();
    std::fs::remove_file(root.path().join("images/view u.png")).unwrap();
    let error = error_of(root.path(), "view u.png");
    assert!(matches!(error, CaptureError::MissingPhoto { .. }));

    std::fs::write(root.path().join("images/view u.png"), b"no photo").unwrap();
    let error = error_of(root.path(), "view u.png");
    assert!(matches!(error, CaptureError::UndecodablePhoto { .. }));

    std::fs::remove_file(root.path().join("sparse/0/images.bin")).unwrap();
    let error = error_of(root.path(), "images.bin");
    assert!(matches!(error, CaptureError::MissingModelFile { .. }));

    std::fs::remove_dir_all(root.path().join("sparse")).unwrap();
    let folder = root.path().to_string_lossy().into_owned();
    assert!(matches!(
        error_of(root.path(), &folder),
        CaptureError::NoModel { .. }
    ));
    let file = root.path().join("transforms.txt");
    std::fs::write(&file, b"{}").unwrap();
    assert!(matches!(
        error_of(&file, "transforms.txt"),
        CaptureError::NotAFolder { .. }
    ));
    let absent = root.path().join("absent");
    assert!(matches!(
        error_of(&absent, "absent"),
        CaptureError::Io { .. }
    ));
}

#[test]
fn one_photo_can_be_looked_at_but_not_trained_on() {
    let (root, mut model) = good();
    model.images.truncate(1);
    model.write_binary(&root.path().join("sparse/0"));
    let capture = load(root.path()).unwrap();
    let message = capture.check_trainable().unwrap_err().to_string();
    assert!(message.contains("at least 2"), "{message}");

    // Unless the capture assigns it to training.
    let split = format!(r#"{{"train": ["{}"], "test": []}}"#, model.images[0].4);
    std::fs::write(root.path().join("split.json"), split).unwrap();
    load(root.path()).unwrap().check_trainable().unwrap();
}

/// Photos are read from the folder of photos, even if the model gives another path.
#[test]
fn a_name_that_leads_out_of_the_folder_is_refused() {
    for name in [
        "../secret.png",
        "a/../../secret.png",
        "/etc/passwd",
        "C:\\photo.png",
        "..\\secret.png",
    ] {
        let message = message_after("images.bin", |model| model.images[3].4 = name.into());
        assert!(message.contains("image 97"), "{message}");
        assert!(message.contains("leads out of the folder"), "{message}");
    }
    // Dots in a name are literal.
    let (root, mut model) = good();
    model.images[3].4 = "a..b...png".into();
    model.write_photos(root.path());
    model.write_binary(&root.path().join("sparse/0"));
    assert_eq!(load(root.path()).unwrap().views[0].name, "a..b...png");
}

/// The second entry replaced the first.
#[test]
fn two_cameras_of_one_id_are_refused() {
    let message = message_after("cameras.bin", |model| model.cameras[1].0 = 7);
    assert!(
        message.contains("camera 7: its id occurs twice"),
        "{message}"
    );
}

/// Squares of such components underflow or overflow, some or all of them.
#[test]
fn quaternions_of_any_length_are_normalised() {
    let viewmat = |length: f64| {
        let (root, mut model) = good();
        for image in &mut model.images {
            image.1 = [0.5, -0.1, 0.7, 0.3].map(|q| q * length);
        }
        model.write_binary(&root.path().join("sparse/0"));
        load(root.path()).unwrap().views[0].viewmat
    };
    let expected = viewmat(1.0);
    for length in [1e-300, 1e-161, 1e-158, 1e160, 1e300] {
        for (row, expected) in viewmat(length).iter().zip(&expected) {
            for (value, expected) in row.iter().zip(expected) {
                assert!(
                    (value - expected).abs() < 1e-15,
                    "{length}: {value} {expected}"
                );
            }
        }
    }
}
