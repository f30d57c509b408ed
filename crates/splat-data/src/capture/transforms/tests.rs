//! Promises of the reader of `transforms.json`: poses, cameras, names, splits, and refusals.

use std::fs;

use serde_json::{Value, json};
use tempfile::TempDir;

use splat_core::Lens;

use super::super::{Capture, Point};
use super::*;
use crate::SceneSettings;

/// A capture of six photos of 24 x 18 pixels in `images/`, around the origin.
fn good() -> Value {
    json!({
        "fl_x": 30.0, "fl_y": 31.0, "cx": 12.5, "cy": 8.5, "w": 24, "h": 18.0,
        "aabb_scale": 4,
        "frames": (0..6).map(|i| json!({
            "file_path": format!("images/{i}.png"),
            "sharpness": 31.75,
            "transform_matrix": pose(i),
        })).collect::<Vec<_>>(),
    })
}

/// A camera at distance 4 that looks at the origin.
fn pose(index: usize) -> Value {
    let (s, c) = (0.9 * index as f64).sin_cos();
    json!([
        [c, 0.0, s, 4.0 * s],
        [0.0, 1.0, 0.0, 0.0],
        [-s, 0.0, c, 4.0 * c],
        [0.0, 0.0, 0.0, 1.0]
    ])
}

fn photo(root: &Path, name: &str) {
    let path = root.join(name);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let pixel = |x, y| image::Rgb([x as u8, y as u8, 7]);
    image::RgbImage::from_fn(24, 18, pixel).save(path).unwrap();
}

/// A folder with this `transforms.json` and the photos of [`good`].
fn folder(json: &Value) -> TempDir {
    let root = TempDir::new().unwrap();
    for i in 0..6 {
        photo(root.path(), &format!("images/{i}.png"));
    }
    write(root.path(), "transforms.json", json);
    root
}

fn write(root: &Path, name: &str, json: &Value) {
    fs::write(root.join(name), json.to_string()).unwrap();
}

fn load(root: &Path) -> Result<Capture, CaptureError> {
    Capture::load(root, &CaptureSettings::new())
}

/// The capture of a changed [`good`], whose only warning is that of its random points.
fn loaded(change: impl FnOnce(&mut Value)) -> Capture {
    let mut json = good();
    change(&mut json);
    let mut capture = load(folder(&json).path()).unwrap();
    assert!(matches!(
        capture.warnings.pop(),
        Some(CaptureWarning::RandomPoints { .. })
    ));
    assert_eq!(capture.warnings, []);
    capture
}

/// The message of a refused change of [`good`].
fn refused(change: impl FnOnce(&mut Value)) -> String {
    let mut json = good();
    change(&mut json);
    let message = load(folder(&json).path()).unwrap_err().to_string();
    assert!(message.contains("transforms.json"), "{message}");
    assert!(!message.contains('\n'), "{message}");
    message
}

fn names(capture: &Capture) -> Vec<&str> {
    capture
        .views
        .iter()
        .map(|view| view.name.as_str())
        .collect()
}

fn test_names(capture: &Capture) -> Vec<&str> {
    capture
        .test_views()
        .map(|view| view.name.as_str())
        .collect()
}

#[test]
fn poses_and_cameras_are_converted() {
    let capture = loaded(|_| {});
    assert_eq!(
        names(&capture),
        ["0.png", "1.png", "2.png", "3.png", "4.png", "5.png"]
    );
    assert!(capture.photos.ends_with("images"));
    assert_eq!(capture.split.test, [0]);
    assert_eq!(capture.background, None);
    let view = &capture.views[1];
    assert_eq!((view.width, view.height), (24, 18));
    assert_eq!(view.intrinsics, [30.0, 31.0, 12.5, 8.5]);
    assert_eq!(view.lens, Lens::Pinhole);
    let position = view.camera().position();
    let (s, c) = 0.9f64.sin_cos();
    assert!(position.distance(glam::DVec3::new(4.0 * s, 0.0, 4.0 * c)) < 1e-12);
    // The origin is ahead; what is above it in OpenGL's world is above it in the photo, and what is
    // to the right of the camera is to its right.
    let (at, depth) = view.project([0.0; 3]).unwrap();
    assert!((depth - 4.0).abs() < 1e-12);
    assert!((at[0] - 12.5).abs() < 1e-12 && (at[1] - 8.5).abs() < 1e-12);
    let (at, _) = view.project([0.0, 0.4, 0.0]).unwrap();
    assert!((at[0] - 12.5).abs() < 1e-12 && (at[1] - (8.5 - 3.1)).abs() < 1e-12);
    let (at, _) = view.project([0.4 * c, 0.0, -0.4 * s]).unwrap();
    assert!((at[0] - (12.5 + 3.0)).abs() < 1e-12 && (at[1] - 8.5).abs() < 1e-12);
    assert_eq!(view.viewmat[3], [0.0, 0.0, 0.0, 1.0]);
}

#[test]
fn lenses_follow_the_camera_model() {
    let lens = |change: &dyn Fn(&mut Value)| loaded(change).views[3].lens;
    let opencv = lens(&|json| {
        for (key, value) in [
            ("k1", 0.1),
            ("k2", -0.02),
            ("p1", 1e-3),
            ("p2", 2e-3),
            ("k3", 3e-3),
        ] {
            json[key] = value.into();
        }
        json["camera_model"] = "OPENCV".into();
        json["k4"] = 0.into();
    });
    let expected = [0.1, -0.02, 1e-3, 2e-3, 3e-3, 0.0, 0.0, 0.0];
    assert_eq!(opencv, Lens::OpenCv(expected));
    let params = lens(&|json| {
        json["k1"] = 9.into();
        json["distortion_params"] = json!([0.1, -0.02, 3e-3, 0.0, 1e-3, 2e-3]);
    });
    assert_eq!(params, opencv);
    let fisheye = |json: &mut Value| {
        for (key, value) in [("k1", 0.1), ("k2", 0.02), ("k3", 1e-3), ("k4", 2e-3)] {
            json[key] = value.into();
        }
    };
    let expected = Lens::OpenCvFisheye([0.1, 0.02, 1e-3, 2e-3]);
    for (key, value) in [
        ("camera_model", json!("OPENCV_FISHEYE")),
        ("is_fisheye", true.into()),
    ] {
        let found = lens(&|json| {
            fisheye(json);
            json[key] = value.clone();
        });
        assert_eq!(found, expected);
    }
    for model in [
        "SIMPLE_PINHOLE",
        "PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "OPENCV",
    ] {
        assert_eq!(
            lens(&|json| json["camera_model"] = model.into()),
            Lens::Pinhole
        );
    }

    let message = refused(fisheye);
    assert!(
        message.contains("k4 is 0.002") && message.contains("undistort"),
        "{message}"
    );
    for model in ["EQUIRECTANGULAR", "FISHEYE624", "VR180_L", "ORTHOPHOTO"] {
        let message = refused(|json| json["camera_model"] = model.into());
        assert!(message.contains(model), "{message}");
    }
    let message = refused(|json| {
        json["camera_model"] = "OPENCV_FISHEYE".into();
        json["p1"] = 0.1.into();
    });
    assert!(message.contains("p1"), "{message}");
}

#[test]
fn a_frame_may_have_its_own_camera() {
    let capture = loaded(|json| {
        json["k1"] = 0.1.into();
        let frame = &mut json["frames"][2];
        frame["fl_x"] = 40.0.into();
        frame["k2"] = 0.05.into();
        for frame in json["frames"].as_array_mut().unwrap() {
            frame["w"] = 24.into();
        }
        json.as_object_mut().unwrap().remove("w");
    });
    let k = |k1, k2| Lens::OpenCv([k1, k2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert_eq!(capture.views[1].lens, k(0.1, 0.0));
    assert_eq!(capture.views[2].lens, k(0.0, 0.05));
    assert_eq!(capture.views[1].intrinsics[..2], [30.0, 31.0]);
    assert_eq!(capture.views[2].intrinsics[..2], [40.0, 31.0]);
}

#[test]
fn a_frame_may_have_its_own_camera_model() {
    let capture = loaded(|json| {
        json["camera_model"] = "OPENCV".into();
        json["k1"] = 0.1.into();
        json["frames"][2]["camera_model"] = "OPENCV_FISHEYE".into();
        json["frames"][2]["k1"] = 0.2.into();
        json["frames"][3]["is_fisheye"] = false.into();
    });
    let perspective = Lens::OpenCv([0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert_eq!(capture.views[1].lens, perspective);
    assert_eq!(
        capture.views[2].lens,
        Lens::OpenCvFisheye([0.2, 0.0, 0.0, 0.0])
    );
    assert_eq!(capture.views[3].lens, perspective);
    // It comes before everything that the top level says, even what cannot be read.
    let capture = loaded(|json| {
        json["camera_model"] = "EQUIRECTANGULAR".into();
        json["is_fisheye"] = true.into();
        for frame in json["frames"].as_array_mut().unwrap() {
            frame["camera_model"] = "PINHOLE".into();
        }
    });
    assert_eq!(capture.views[2].lens, Lens::Pinhole);

    let message = refused(|json| json["frames"][2]["camera_model"] = "EQUIRECTANGULAR".into());
    for word in ["frames[2] (`images/2.png`)", "EQUIRECTANGULAR"] {
        assert!(message.contains(word), "{message}");
    }
    // The top level's coefficients are those of another formula.
    let message = refused(|json| {
        json["k1"] = 0.1.into();
        json["frames"][2]["camera_model"] = "OPENCV_FISHEYE".into();
    });
    for word in ["frames[2]", "a fisheye", "coefficients of its own"] {
        assert!(message.contains(word), "{message}");
    }
}

#[test]
fn is_fisheye_agrees_with_the_camera_model() {
    let lens = |model: Option<&str>, flag: Value| {
        loaded(|json| {
            json["camera_model"] = model.into();
            json["is_fisheye"] = flag;
        })
        .views[3]
            .lens
    };
    let fisheye = Lens::OpenCvFisheye([0.0; 4]);
    for yes in [json!(true), json!(1), json!(1.0)] {
        assert_eq!(lens(None, yes.clone()), fisheye);
        assert_eq!(lens(Some("OPENCV_FISHEYE"), yes.clone()), fisheye);
        let message = refused(|json| {
            json["camera_model"] = "OPENCV".into();
            json["is_fisheye"] = yes;
        });
        for word in [
            "the top level",
            "is_fisheye",
            "camera_model to OPENCV_FISHEYE",
        ] {
            assert!(message.contains(word), "{message}");
        }
    }
    for no in [json!(false), json!(0), Value::Null] {
        assert_eq!(lens(None, no.clone()), Lens::Pinhole);
        assert_eq!(lens(Some("OPENCV"), no.clone()), Lens::Pinhole);
        assert_eq!(lens(Some("OPENCV_FISHEYE"), no), fisheye);
    }
    let message = refused(|json| {
        json["camera_model"] = "PINHOLE".into();
        json["frames"][4]["is_fisheye"] = true.into();
    });
    assert!(message.contains("frames[4]"), "{message}");
    let message = refused(|json| json["is_fisheye"] = "yes".into());
    assert!(
        message.contains("its is_fisheye is the text `yes`"),
        "{message}"
    );
}

#[test]
fn coefficients_without_a_term_are_refused() {
    for model in ["OPENCV", "OPENCV_FISHEYE"] {
        let with = |key: &str, value: f64| {
            let mut json = good();
            json["camera_model"] = model.into();
            json[key] = value.into();
            json
        };
        for key in ["k5", "k6"] {
            load(folder(&with(key, 0.0)).path()).unwrap();
            let message = refused(|json| *json = with(key, 0.01));
            let says = |word: &str| assert!(message.contains(word), "{message}");
            says("the top level");
            says(&format!("its {key} is 0.01"));
            says("undistort");
        }
    }
    let message = refused(|json| {
        json["frames"][1]["k6"] = 0.5.into();
        json["frames"][1]["distortion_params"] = json!([0.1]);
    });
    assert!(message.contains("frames[1]"), "{message}");
}

/// A frame that is zoomed in another way than the others.
#[test]
fn an_angle_of_a_frame_comes_before_focal_lengths_of_the_file() {
    let capture = loaded(|json| {
        json["camera_angle_x"] = 0.7.into();
        json["frames"][2]["camera_angle_x"] = 0.2.into();
        json["frames"][3]["camera_angle_y"] = 0.3.into();
        json["frames"][4]["camera_angle_x"] = 0.2.into();
        json["frames"][4]["fl_x"] = 50.0.into();
    });
    let f = |side: f64, angle: f64| 0.5 * side / (0.5 * angle).tan();
    let focal = |index: usize| &capture.views[index].intrinsics[..2];
    assert_eq!(focal(1), [30.0, 31.0]);
    assert_eq!(focal(2), [f(24.0, 0.2); 2]);
    assert_eq!(focal(3), [f(18.0, 0.3); 2]);
    assert_eq!(focal(4), [50.0, 50.0]);
    assert_eq!(capture.views[2].intrinsics[2..], [12.5, 8.5]);
}

/// As Brush and instant-ngp accept: from the field of view and the photo's size.
#[test]
fn an_angle_is_enough() {
    let only = |keys: Value| {
        loaded(|json| {
            let frames = json["frames"].take();
            *json = keys;
            json["frames"] = frames;
        })
        .views[0]
            .intrinsics
    };
    let f = |side: f64, angle: f64| 0.5 * side / (0.5 * angle).tan();
    let (x, y) = (f(24.0, 0.7), f(18.0, 0.5));
    assert_eq!(only(json!({"camera_angle_x": 0.7})), [x, x, 12.0, 9.0]);
    assert_eq!(only(json!({"camera_angle_y": 0.5})), [y, y, 12.0, 9.0]);
    let both = json!({"camera_angle_x": 0.7, "camera_angle_y": 0.5, "cx": 11.5});
    assert_eq!(only(both), [x, y, 11.5, 9.0]);
    // Focal lengths are more exact than angles that follow from them.
    let all = json!({"camera_angle_x": 0.7, "camera_angle_y": 0.5, "fl_x": 30.0});
    assert_eq!(only(all), [30.0, 30.0, 12.0, 9.0]);
    // Of a size that the photos were reduced from.
    let size = json!({"camera_angle_x": 0.7, "w": 240, "h": 180});
    let found = load(
        folder(&{
            let mut json = size.clone();
            json["frames"] = good()["frames"].clone();
            json
        })
        .path(),
    );
    let found = found.unwrap();
    assert!((found.views[0].intrinsics[0] - x).abs() < 1e-12);
    let rescaled = |w: &CaptureWarning| matches!(w, CaptureWarning::RescaledPhotos { .. });
    assert!(found.warnings.iter().any(rescaled));
}

#[test]
fn nonsense_is_named() {
    type Change = fn(&mut Value);
    let cases: [(&str, Change); 25] = [
        ("`frames` is missing", |json| *json = json!({})),
        ("`frames` is missing or empty", |json| {
            json["frames"] = json!([])
        }),
        ("frames is an object", |json| json["frames"] = json!({})),
        ("frames[1] is 7", |json| json["frames"][1] = 7.into()),
        ("a list instead of an object", |json| *json = json!([])),
        ("frames[2]: its file_path is missing", |json| {
            json["frames"][2]
                .as_object_mut()
                .unwrap()
                .remove("file_path");
        }),
        ("frames[2]: its file_path is 4", |json| {
            json["frames"][2]["file_path"] = 4.into()
        }),
        ("file_path is no file", |json| {
            json["frames"][2]["file_path"] = "..".into()
        }),
        ("file_path is no file", |json| {
            json["frames"][2]["file_path"] = "a\nb".into()
        }),
        (
            "frames[2] (`images/2.png`): its transform_matrix is missing",
            |json| {
                json["frames"][2]["transform_matrix"] = Value::Null;
            },
        ),
        ("no matrix of 4x4", |json| {
            json["frames"][2]["transform_matrix"][1] = json!([1, 2])
        }),
        ("no matrix of 4x4", |json| {
            json["frames"][2]["transform_matrix"][1][3] = "x".into()
        }),
        ("no pose", |json| {
            json["frames"][2]["transform_matrix"][1][1] = (-1.0).into()
        }),
        ("no pose", |json| {
            json["frames"][2]["transform_matrix"][1][1] = 2.0.into()
        }),
        ("no pose", |json| {
            json["frames"][2]["transform_matrix"] = json!(vec![[0.0; 4]; 4])
        }),
        ("its fl_x is 0", |json| json["fl_x"] = 0.into()),
        ("its fl_x is the text `30`", |json| {
            json["fl_x"] = "30".into()
        }),
        ("its w is 24.5", |json| json["w"] = 24.5.into()),
        ("its h is 0", |json| json["h"] = 0.into()),
        ("w is missing", |json| json["w"] = Value::Null),
        ("its focal length is missing", |json| {
            (json["fl_x"], json["fl_y"]) = (Value::Null, Value::Null);
        }),
        ("its camera_angle_x is 4", |json| {
            (json["fl_x"], json["camera_angle_x"]) = (Value::Null, 4.0.into());
        }),
        ("its camera_angle_x is 0.0000000001", |json| {
            (json["fl_x"], json["camera_angle_x"]) = (Value::Null, 1e-10.into());
        }),
        ("distortion_params[1] is null", |json| {
            json["distortion_params"] = json!([1, null])
        }),
        ("test_filenames has 3", |json| {
            json["test_filenames"] = json!([3])
        }),
    ];
    for (word, change) in cases {
        let message = refused(change);
        assert!(message.contains(word), "`{message}` does not say `{word}`");
    }
}

#[test]
fn text_that_is_no_json_is_named() {
    let root = folder(&good());
    let path = root.path().join("transforms.json");
    let text = good().to_string();
    let deep = format!(
        "{{\"frames\": {}1{}}}",
        "[".repeat(9_999),
        "]".repeat(9_999)
    );
    for (bytes, word) in [
        (text.as_bytes()[..text.len() / 2].to_vec(), "no JSON"),
        (text.replace("30.0", "1e999").into_bytes(), "out of range"),
        (text.replace("30.0", "NaN").into_bytes(), "NaN"),
        (deep.into_bytes(), "recursion"),
        (vec![], "no JSON"),
        (b"\xff\xfe{\0".to_vec(), "UTF-16"),
        (b"{\"a\": \"\xff\"}".to_vec(), "UTF-8"),
    ] {
        fs::write(&path, bytes).unwrap();
        let message = load(root.path()).unwrap_err().to_string();
        assert!(
            message.contains("transforms.json") && message.contains(word),
            "{message}"
        );
    }
    fs::write(&path, format!("\u{feff}{text}")).unwrap();
    load(root.path()).unwrap();
}

/// Rotations with few digits are made exact; a scale of the whole matrix is not a part of the pose.
#[test]
fn rounded_and_scaled_rotations_are_made_exact() {
    let capture = loaded(|json| {
        for frame in json["frames"].as_array_mut().unwrap() {
            for row in &mut frame["transform_matrix"].as_array_mut().unwrap()[..3] {
                for value in &mut row.as_array_mut().unwrap()[..3] {
                    *value = json!((value.as_f64().unwrap() * 1e4).round() / 1e4 * 2.5);
                }
            }
        }
    });
    for view in &capture.views {
        let m = view.viewmat;
        for (a, b) in [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)] {
            let dot: f64 = (0..3).map(|i| m[a][i] * m[b][i]).sum();
            assert!((dot - f64::from(u8::from(a == b))).abs() < 1e-14);
        }
        let (_, depth) = view.project([0.0; 3]).unwrap();
        assert!((depth - 4.0).abs() < 1e-3);
    }
}

#[test]
fn the_last_row_of_a_pose_is_checked() {
    let message = refused(|json| json["frames"][2]["transform_matrix"][3][3] = 2.0.into());
    for word in [
        "frames[2] (`images/2.png`)",
        "last row of its transform_matrix is [0.0, 0.0, 0.0, 2.0]",
        "without a scale",
    ] {
        assert!(message.contains(word), "{message}");
    }
    let message = refused(|json| json["frames"][2]["transform_matrix"][3][1] = 0.5.into());
    assert!(message.contains("[0.0, 0.5, 0.0, 1.0]"), "{message}");
    assert!(!message.contains("transposed"), "{message}");
    let message = refused(|json| {
        for frame in json["frames"].as_array_mut().unwrap() {
            let rows = frame["transform_matrix"].take();
            let column = |at: usize| {
                (0..4)
                    .map(|row: usize| rows[row][at].clone())
                    .collect::<Vec<_>>()
            };
            frame["transform_matrix"] = (0..4).map(column).collect::<Vec<_>>().into();
        }
    });
    for word in ["frames[0]", "[0.0, 0.0, 4.0, 1.0]", "looks transposed"] {
        assert!(message.contains(word), "{message}");
    }
    // Numbers in single precision; and rows of which the last is left out.
    let same = loaded(|json| {
        json["frames"][2]["transform_matrix"][3] = json!([1e-7, -0.0, 0.0, 1.0000001]);
        let rows = json["frames"][3]["transform_matrix"].as_array_mut();
        rows.unwrap().truncate(3);
    });
    for (view, other) in same.views.iter().zip(loaded(|_| {}).views) {
        assert_eq!(view.viewmat, other.viewmat);
    }
}

#[test]
fn photos_may_be_anywhere_and_names_stay_inside() {
    let outer = TempDir::new().unwrap();
    let root = outer.path().join("processed/run");
    fs::create_dir_all(&root).unwrap();
    for i in 0..6 {
        photo(outer.path(), &format!("processed/images/sub/{i}.png"));
    }
    let absolute = outer.path().join("processed/images/sub");
    let mut json = good();
    for (i, frame) in json["frames"]
        .as_array_mut()
        .unwrap()
        .iter_mut()
        .enumerate()
    {
        frame["file_path"] = match i % 3 {
            0 => format!("../images/./sub/{i}.png"),
            1 => format!("..\\images\\sub\\{i}"),
            _ => format!("{}/{i}.png", absolute.display()),
        }
        .into();
    }
    json["test_filenames"] = json!(["../images/sub/3.png", json["frames"][2]["file_path"]]);
    write(&root, "transforms.json", &json);
    let capture = load(&root).unwrap();
    assert_eq!(
        names(&capture),
        ["0.png", "1.png", "2.png", "3.png", "4.png", "5.png"]
    );
    assert_eq!(test_names(&capture), ["2.png", "3.png"]);
    assert!(capture.photo_files().iter().all(|file| file.is_file()));
    assert_eq!(capture.root, root);
    assert_eq!(capture.name, "run");
}

/// A folder of smaller photos with the same names.
#[test]
fn another_folder_of_photos_can_be_named() {
    let root = folder(&good());
    fs::rename(root.path().join("images"), root.path().join("images_2")).unwrap();
    let message = load(root.path()).unwrap_err().to_string();
    assert!(
        message.contains("6 of its 6 frames") && message.contains("0.png"),
        "{message}"
    );
    let options = CaptureSettings::new().with_images(PathBuf::from("images_2"));
    let capture = Capture::load(root.path(), &options).unwrap();
    assert_eq!(capture.views.len(), 6);
    assert!(capture.photos.ends_with("images_2"));
}

#[test]
fn frames_without_a_photo_are_skipped_if_they_are_few() {
    let mut json = good();
    json["test_filenames"] = json!(["images/1.png", "images/4.png"]);
    let root = folder(&json);
    for i in [4, 2, 5] {
        fs::remove_file(root.path().join(format!("images/{i}.png"))).unwrap();
    }
    let capture = load(root.path()).unwrap();
    assert_eq!(names(&capture), ["0.png", "1.png", "3.png"]);
    assert_eq!(test_names(&capture), ["1.png"]);
    let message = capture.warnings[0].to_string();
    assert!(
        message.contains("3 of 6 frames") && message.contains("2.png"),
        "{message}"
    );
    assert_eq!(capture.warnings.len(), 2);
    fs::remove_file(root.path().join("images/0.png")).unwrap();
    let message = load(root.path()).unwrap_err().to_string();
    assert!(message.contains("4 of its 6 frames"), "{message}");
}

#[test]
fn a_photo_is_in_one_frame() {
    let message =
        refused(|json| json["frames"][4]["file_path"] = "./images/../images/1.png".into());
    assert!(message.contains("frames[4]"), "{message}");
    assert!(message.contains("frames[1]"), "{message}");
    let message = refused(|json| json["frames"][4]["file_path"] = "images/1".into());
    assert!(message.contains("`1.png`"), "{message}");
}

#[test]
fn lists_of_names_are_the_split() {
    let capture = loaded(|json| json["test_filenames"] = json!(["./images/3.png"]));
    assert_eq!(test_names(&capture), ["3.png"]);
    assert_eq!(capture.split.train, [0, 1, 2, 4, 5]);
    let capture = loaded(|json| {
        json["train_filenames"] = json!(["images/0.png", "images/1.png", "images/2.png"]);
        json["val_filenames"] = json!(["images/3.png", "images/4.png", "images/5.png"]);
        json["test_filenames"] = json!([]);
    });
    assert_eq!(
        (capture.split.train, capture.split.test),
        (vec![0, 1, 2], vec![3, 4, 5])
    );
    let message = refused(|json| {
        json["train_filenames"] = json!(["images/0.png", "images/1.png"]);
        json["test_filenames"] = json!(["./images/1.png"]);
    });
    for word in ["`1.png`", "`train_filenames`", "`test_filenames`"] {
        assert!(message.contains(word), "{message}");
    }
    let message = refused(|json| json["test_filenames"] = json!(["images/1.png", "images/1.png"]));
    assert!(message.contains("`1.png` twice"), "{message}");
    let mut json = good();
    json["train_filenames"] = json!(["images/0.png", "images/8.png"]);
    json["test_filenames"] = json!(["images/5.png"]);
    let capture = load(folder(&json).path()).unwrap();
    assert_eq!(
        (capture.split.train, capture.split.test),
        (vec![0], vec![5])
    );
    let messages: Vec<String> = capture.warnings.iter().map(ToString::to_string).collect();
    let said = |words: &[&str]| {
        messages
            .iter()
            .any(|m| words.iter().all(|word| m.contains(word)))
    };
    assert!(said(&["transforms.json names 1", "8.png"]), "{messages:?}");
    assert!(said(&["transforms.json puts 4", "1.png"]), "{messages:?}");
}

const PLY: &str = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n\
    property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n\
    1 2 3 4 5 6\n-1 0 0.5 255 0 9\n";

/// In the world of the poses as they are in the file.
#[test]
fn points_are_read_from_ply() {
    let mut json = good();
    json["applied_transform"] = json!([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]);
    json["applied_scale"] = 3.0.into();
    let root = folder(&json);
    fs::write(root.path().join("sparse_pc.ply"), PLY).unwrap();
    let capture = load(root.path()).unwrap();
    assert_eq!(capture.warnings, []);
    let point = |position, color| Point { position, color };
    let expected = [
        point([1.0, 2.0, 3.0], [4, 5, 6]),
        point([-1.0, 0.0, 0.5], [255, 0, 9]),
    ];
    assert_eq!(capture.points, expected);
    assert!((capture.views[0].camera().position().z - 4.0).abs() < 1e-12);

    json["ply_file_path"] = "more/points.ply".into();
    write(root.path(), "transforms.json", &json);
    let message = load(root.path()).unwrap_err().to_string();
    for word in [
        "transforms.json: the top level",
        "ply_file_path",
        "points.ply",
        "remove the field",
    ] {
        assert!(message.contains(word), "{message}");
    }
    fs::create_dir(root.path().join("more")).unwrap();
    let path = root.path().join("more/points.ply");
    fs::write(&path, PLY.replace("1 2 3 4", "8 2 3 4")).unwrap();
    assert_eq!(
        load(root.path()).unwrap().points[0].position,
        [8.0, 2.0, 3.0]
    );
    for (text, word) in [
        (
            PLY.replace("1 2 3 4", "1 nan 3 4"),
            "point 0 (counted from 0): its y is NaN",
        ),
        (PLY.replace("vertex 2", "vertex 3"), "point 2"),
        (PLY.replace("float z", "float w"), "`z`"),
        ("solid".to_owned(), "no PLY header"),
    ] {
        fs::write(&path, text).unwrap();
        let message = load(root.path()).unwrap_err().to_string();
        assert!(
            message.contains("points.ply") && message.contains(word),
            "{message}"
        );
        assert!(!message.contains("Gaussian"), "{message}");
    }
}

#[test]
fn masks_and_depth_maps_are_found() {
    let mut json = good();
    json["frames"][1]["mask_path"] = "m/1.png".into();
    json["frames"][1]["depth_file_path"] = "d/1.png".into();
    let root = folder(&json);
    for field in ["mask_path", "depth_file_path"] {
        let message = load(root.path()).unwrap_err().to_string();
        let says = |word: &str| assert!(message.contains(word), "{message}");
        says("frames[1]");
        says(field);
        fs::create_dir_all(root.path().join("m")).unwrap();
        fs::create_dir_all(root.path().join("d")).unwrap();
        let file = if field == "mask_path" {
            "m/1.png"
        } else {
            "d/1.png"
        };
        let mask = image::GrayImage::from_fn(24, 18, |x, _| image::Luma([x as u8 * 10]));
        mask.save(root.path().join(file)).unwrap();
    }
    let capture = load(root.path()).unwrap();
    let view = &capture.views[1];
    assert_eq!(view.mask.as_ref().unwrap()[..3], [0, 10, 20]);
    assert_eq!(view.depth.as_deref(), Some(&*root.path().join("d/1.png")));
    assert_eq!(
        (&capture.views[2].mask, &capture.views[2].depth),
        (&None, &None)
    );
    assert_eq!(view.downscaled(1).depth, view.depth);
}

/// A Blender capture with photos of two views for training and one held out.
fn blender() -> TempDir {
    let root = TempDir::new().unwrap();
    for (name, frames) in [("train", vec![0, 1]), ("test", vec![2]), ("val", vec![3])] {
        let frame = |&i: &usize| {
            let file = format!("{name}/r_{i}.png");
            fs::create_dir_all(root.path().join(name)).unwrap();
            let pixel = |x, _| image::Rgba([200, 100, 50, [0, 128, 255][x as usize % 3]]);
            let photo = image::RgbaImage::from_fn(24, 18, pixel);
            photo.save(root.path().join(file)).unwrap();
            json!({"file_path": format!("./{name}/r_{i}"), "rotation": 0.01, "transform_matrix": pose(i)})
        };
        let frames: Vec<Value> = frames.iter().map(frame).collect();
        let json = json!({"camera_angle_x": 0.7, "frames": frames});
        write(root.path(), &format!("transforms_{name}.json"), &json);
    }
    root
}

#[test]
fn blender_captures_are_on_white() {
    let root = blender();
    let capture = load(root.path()).unwrap();
    assert_eq!(
        names(&capture),
        ["test/r_2.png", "train/r_0.png", "train/r_1.png"]
    );
    assert_eq!(
        (&*capture.split.test, &*capture.split.train),
        (&[0][..], &[1, 2][..])
    );
    assert_eq!(capture.background, Some([1.0; 3]));
    // Which a scene of it need not say, nor its size.
    let mut settings = SceneSettings::default();
    settings.complete_from(&capture);
    let size = capture.scene_scale().length();
    assert_eq!(settings.scene_scale, Some(size));
    assert_eq!(settings.background, Some([1.0; 3]));
    settings.scene_scale = Some(2.0 * size);
    settings.background = Some([0.5; 3]);
    let said = settings.clone();
    settings.complete_from(&capture);
    assert_eq!(settings, said);
    let view = &capture.views[0];
    // 255 - (255 - 200) 128 / 255, and so on.
    assert_eq!(
        view.image[..9],
        [255, 255, 255, 227, 177, 152, 200, 100, 50]
    );
    assert_eq!(view.mask, None);
    let f = 12.0 / 0.35f64.tan();
    assert_eq!(view.intrinsics, [f, f, 12.0, 9.0]);
    let [
        CaptureWarning::RandomPoints {
            count: 100_000,
            half_side: 1.3,
            ..
        },
    ] = capture.warnings[..]
    else {
        panic!("a warning, not {:?}", capture.warnings);
    };
    let most = |point: &Point| point.position.iter().fold(0.0, |m: f64, x| m.max(x.abs()));
    let largest = capture.points.iter().map(most).fold(0.0, f64::max);
    assert!((1.29..=1.3).contains(&largest), "{largest}");

    fs::write(root.path().join("points3d.ply"), PLY).unwrap();
    let capture = load(root.path()).unwrap();
    assert_eq!((capture.points.len(), capture.warnings.len()), (2, 0));
    // Without test views, those for validation are held out.
    fs::remove_file(root.path().join("transforms_test.json")).unwrap();
    let capture = load(root.path()).unwrap();
    assert_eq!(test_names(&capture), ["val/r_3.png"]);
    // And without those, as in other captures.
    fs::remove_file(root.path().join("transforms_val.json")).unwrap();
    let capture = load(root.path()).unwrap();
    assert_eq!(test_names(&capture), ["r_0.png"]);
    assert_eq!(capture.background, Some([1.0; 3]));
}

/// Files of a split beside the file of all frames.
#[test]
fn the_split_of_files_comes_before_one_file() {
    let root = folder(&good());
    let part = |range: std::ops::Range<usize>| {
        let mut json = good();
        json["frames"] = good()["frames"].as_array().unwrap()[range].to_vec().into();
        json
    };
    write(root.path(), "transforms_train.json", &part(0..4));
    write(root.path(), "transforms_test.json", &part(3..5));
    let capture = load(root.path()).unwrap();
    assert_eq!(
        names(&capture),
        ["0.png", "1.png", "2.png", "3.png", "4.png"]
    );
    assert_eq!(test_names(&capture), ["4.png"]);
    // With intrinsics in pixels it is no Blender capture.
    assert_eq!(capture.background, None);
    let messages: Vec<String> = capture.warnings.iter().map(ToString::to_string).collect();
    assert!(
        messages[0].contains("transforms_train.json and transforms_test.json"),
        "{messages:?}"
    );
    assert!(
        messages[1].contains("1 held-out") && messages[1].contains("3.png"),
        "{messages:?}"
    );
    // A file can be named itself.
    let capture = load(&root.path().join("transforms.json")).unwrap();
    assert_eq!(capture.views.len(), 6);
    assert_eq!(capture.root, root.path());

    // COLMAP comes before both.
    let model = super::super::test_capture::TestCapture::new();
    model.write_binary(&root.path().join("sparse/0"));
    model.write_photos(root.path());
    let capture = load(root.path()).unwrap();
    assert_eq!(capture.views.len(), 9);
    let message = capture.warnings[0].to_string();
    assert!(
        message.contains("COLMAP") && message.contains("transforms.json"),
        "{message}"
    );
}
