//! Captures with unusual layouts: photos in a folder of another name, and views whose pictures
//! would share a name.
#![cfg(feature = "cpu")]

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use splat_data::{Capture, CaptureSettings};
use tempfile::TempDir;

fn splat(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_splat"))
        .args(["--device", "cpu"])
        .args(arguments)
        .output()
        .unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// The program's messages on success.
fn said(arguments: &[&str]) -> String {
    let output = splat(arguments);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{arguments:?}: {said}");
    said
}

/// The program's error: one line, with exit status 2.
fn refusal(arguments: &[&str]) -> String {
    let output = splat(&[&["--quiet"], arguments].concat());
    let line = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {line}");
    assert_eq!(line.trim_end().lines().count(), 1, "{line}");
    line
}

/// The example at an eighth of its size, with held-out views called `names`.
fn small_example(into: &Path, names: [&str; 4]) -> PathBuf {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/data/saharov");
    let options = CaptureSettings {
        downscale: 8,
        ..CaptureSettings::default()
    };
    let mut capture = Capture::load(&source, &options).unwrap();
    for (&view, name) in capture.split.test.iter().zip(names) {
        name.clone_into(&mut capture.views[view].name);
    }
    let folder = into.join("capture");
    capture.save(&folder).unwrap();
    folder
}

fn files(folder: &Path) -> BTreeSet<String> {
    let names = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name());
    names.map(|name| name.into_string().unwrap()).collect()
}

#[test]
fn every_view_gets_its_picture() {
    let folder = TempDir::new().unwrap();
    let names = ["shot.png", "shot.jpg", "a/b_c.png", "a_b/c.png"];
    let capture = small_example(folder.path(), names);
    let out = folder.path().join("out");
    let said_of_train = said(&["train", text(&capture), "--out", text(&out), "--steps", "1"]);
    assert!(
        said_of_train.contains("`shot.png` as shot_png.png"),
        "{said_of_train}"
    );
    let expected = ["a_b_c_1.png", "a_b_c_2.png", "shot_jpg.png", "shot_png.png"];
    assert!(
        files(&out.join("views")).iter().eq(expected),
        "{:?}",
        files(&out.join("views"))
    );

    // All views, with two files each.
    let pictures = folder.path().join("pictures");
    let scene = out.join("scene.ply");
    let arguments = [
        "render",
        text(&scene),
        "--capture",
        text(&capture),
        "--out",
        text(&pictures),
    ];
    said(&[&arguments[..], &["--channels", "rgb,alpha"]].concat());
    let pictures = files(&pictures);
    assert_eq!(pictures.len(), 2 * 32, "{pictures:?}");
    for name in expected {
        let alpha = name.replace(".png", ".alpha.png");
        assert!(
            pictures.contains(name) && pictures.contains(&alpha),
            "{pictures:?}"
        );
    }
}

#[test]
fn photos_may_lie_in_a_folder_of_another_name() {
    let folder = TempDir::new().unwrap();
    let capture = small_example(folder.path(), ["0.png", "1.png", "2.png", "3.png"]);
    fs::rename(capture.join("images"), capture.join("my photos")).unwrap();
    let out = folder.path().join("out");
    let capture = text(&capture);
    let train = ["train", capture, "--out", text(&out), "--steps", "1"];
    let line = refusal(&train);
    assert!(
        line.contains("--images") && line.contains("`my photos`"),
        "{line}"
    );
    assert!(!out.exists());
    let line = refusal(&[&train[..], &["--images", "nowhere"]].concat());
    assert!(
        line.contains("nowhere") && line.contains("`my photos`"),
        "{line}"
    );

    let images = ["--images", "my photos"];
    said(&[&train[..], &images].concat());
    let scene = out.join("scene.ply");
    let scene = text(&scene);
    let pictures = folder.path().join("pictures");
    let render = ["render", scene, "--out", text(&pictures)];
    for command in [
        &["info", capture][..],
        &["eval", capture, scene],
        &[&render[..], &["--capture", capture, "--downscale", "2"]].concat(),
        &[
            "bench",
            "rasterize",
            scene,
            "--capture",
            capture,
            "--seconds",
            "0",
        ],
    ] {
        refusal(command);
        said(&[command, &images].concat());
    }
    let (width, height) = image::image_dimensions(pictures.join("0.png")).unwrap();
    let photo = Path::new(capture).join("my photos/0.png");
    let photo = image::image_dimensions(photo).unwrap();
    assert_eq!((width, height), (photo.0 / 2, photo.1 / 2));

    // The option is an error where no photo is read.
    for command in [
        &["info", scene][..],
        &[&render[..], &["--orbit", "1"]].concat(),
    ] {
        let line = refusal(&[command, &images].concat());
        assert!(line.contains("--images"), "{line}");
    }
}

/// Neither pictures of all views nor those of the held-out ones may replace a photo.
#[test]
fn no_photo_is_replaced_by_a_picture() {
    let folder = TempDir::new().unwrap();
    let capture = small_example(folder.path(), ["0.png", "1.png", "2.png", "3.png"]);
    let out = folder.path().join("out");
    said(&["train", text(&capture), "--out", text(&out), "--steps", "1"]);
    let scene = out.join("scene.ply");
    fs::rename(capture.join("images"), capture.join("views")).unwrap();
    let photos = capture.join("views");
    let bytes = |name: &str| fs::read(photos.join(name)).unwrap();
    let before = bytes("0.png");

    let views = ["--capture", text(&capture), "--images", "views"];
    let render = ["render", text(&scene), "--out", text(&photos)];
    let train = ["train", text(&capture), "--images", "views", "--steps", "1"];
    for arguments in [
        [&render[..], &views[..]].concat(),
        [&train[..], &["--out", text(&capture)]].concat(),
    ] {
        let line = refusal(&arguments);
        assert!(
            line.contains("0.png") && line.contains("the command reads it"),
            "{line}"
        );
        assert_eq!(bytes("0.png"), before);
    }
    let json = ["eval", text(&capture), text(&scene), "--images", "views"];
    let line = refusal(&[&json[..], &["--json", text(&scene)]].concat());
    assert!(line.contains("scene.ply"), "{line}");
    assert!(fs::read(&scene).unwrap().starts_with(b"ply"));
}
