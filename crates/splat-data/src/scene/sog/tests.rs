//! Promises of the reader and the writer.

use std::io::Write;
use std::path::Path;

use serde_json::{Value, json};
use tempfile::TempDir;

use super::super::test_scene::{difference, opacities, rotation_difference, scene};
use super::*;
use crate::SceneSettings;

/// Names and contents of files.
type NamedFiles = Vec<(&'static str, Vec<u8>)>;

fn written(scene: &SplatData) -> Vec<u8> {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("scene.sog");
    write(&path, scene).unwrap();
    // No other file is left.
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    std::fs::read(path).unwrap()
}

fn round_trip(scene: &SplatData) -> SplatData {
    parse(Path::new("scene.sog"), &written(scene)).unwrap()
}

/// The message of reading a bad file, which must be one line and name the file.
fn message_of(bytes: &[u8]) -> String {
    let error = parse(Path::new("scene.sog"), bytes).expect_err("the file is bad");
    let message = error.to_string();
    assert!(message.starts_with("scene.sog: "), "`{message}`");
    assert!(!message.contains('\n'), "`{message}`");
    message
}

/// An archive of files, deflated.
fn archive(files: &[(&str, Vec<u8>)]) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(vec![]));
    let deflated = zip::write::SimpleFileOptions::default()
        .compression_method(zip::CompressionMethod::Deflated);
    for (name, contents) in files {
        zip.start_file(*name, deflated).unwrap();
        zip.write_all(contents).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

fn webp(width: u32, height: u32, pixels: &[[u8; 4]]) -> Vec<u8> {
    let grid = Grid { width, height };
    image::encode(Path::new("a"), "a", grid, pixels).unwrap()
}

/// The files of two Gaussians of degree 1, by hand, in an image of 4 x 1 pixels.
fn by_hand() -> (Value, NamedFiles) {
    let meta = json!({
        "version": 2,
        "count": 2,
        "antialias": true,
        "means": {
            "mins": [-1.0, 0.0, 0.0],
            "maxs": [1.0, 2.0, 0.0],
            "files": ["low.webp", "high.webp"]
        },
        "scales": {"codebook": [null, -2.5, -1.0], "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": [-0.5, 0.25, 1.5], "files": ["sh0.webp"]},
        "shN": {
            "count": 66,
            "bands": 1,
            "codebook": [-0.75, 0.0, 0.5],
            "files": ["centroids.webp", "labels.webp"]
        },
        "extras": {"other": "program"}
    });
    // 192 x 2 pixels: entry 65 is the second of the second row.
    let mut centroids = vec![[0; 4]; 192 * 2];
    centroids[192 + 3..192 + 6].copy_from_slice(&[[1, 2, 0, 255], [2, 2, 2, 255], [1, 1, 0, 255]]);
    let files = vec![
        (
            "low.webp",
            webp(4, 1, &[[0, 0, 9, 255], [0xff, 0xcd, 0, 255]]),
        ),
        (
            "high.webp",
            webp(4, 1, &[[0, 0, 9, 255], [0xff, 0xab, 0, 255]]),
        ),
        ("scales.webp", webp(4, 1, &[[0, 1, 2, 255], [1, 1, 1, 255]])),
        // 0.5 sqrt(2) (51 / 255 - 0.5) is negative; the largest is x, then w.
        (
            "quats.webp",
            webp(4, 1, &[[51, 255, 0, 253], [255, 128, 127, 252]]),
        ),
        ("sh0.webp", webp(4, 1, &[[0, 1, 2, 0], [2, 2, 2, 51]])),
        ("centroids.webp", webp(192, 2, &centroids)),
        (
            "labels.webp",
            webp(4, 1, &[[65, 0, 0, 255], [0, 0, 0, 255]]),
        ),
    ];
    (meta, files)
}

fn joined(meta: &Value, mut files: NamedFiles) -> Vec<u8> {
    files.push(("meta.json", serde_json::to_vec_pretty(meta).unwrap()));
    archive(&files)
}

#[test]
fn an_archive_is_read_as_the_layout_says() {
    let (meta, files) = by_hand();
    let scene = parse(Path::new("scene.sog"), &joined(&meta, files)).unwrap();
    let e = std::f32::consts::E;
    // -1 is the logarithm of 1 - e, 1 of e - 1; 0xabcd / 0xffff of the way from 0 to 2.
    let y = (2.0 * f64::from(0xabcd) / 65_535.0).exp_m1() as f32;
    assert!(
        difference(
            scene.means.as_flattened(),
            &[1.0 - e, 0.0, 0.0, e - 1.0, y, 0.0]
        ) < 1e-5
    );
    assert_eq!(
        scene.log_scales,
        [[f32::NEG_INFINITY, -2.5, -1.0], [-2.5; 3]]
    );
    let half = 0.5f32.sqrt();
    let small = 2f32.sqrt() * (51.0 / 255.0 - 0.5);
    // (w, x, y, z) with w small, y and z at their ends, and nothing left for x.
    assert!(difference(&scene.quats[0], &[small, 0.0, half, -half]) < 1e-6);
    let tiny = 2f32.sqrt() * 0.5 / 255.0;
    let w = (0.5 - 2.0 * tiny * tiny).sqrt();
    assert!(difference(&scene.quats[1], &[w, half, tiny, -tiny]) < 1e-6);
    assert_eq!(scene.sh0, [[-0.5, 0.25, 1.5], [1.5; 3]]);
    assert_eq!(scene.opacity_logits[0], f32::NEG_INFINITY);
    assert!((scene.opacity_logits[1] - 0.25f32.ln()).abs() < 1e-6);
    assert_eq!(scene.sh_degree, 1);
    let first = [0.0, 0.5, -0.75, 0.5, 0.5, 0.5, 0.0, 0.0, -0.75];
    assert_eq!(scene.sh_rest[..9], first);
    assert_eq!(scene.sh_rest[9..], [-0.75; 9]);
    assert_eq!(scene.settings.antialias, Some(true));
}

#[test]
fn a_folder_is_read_like_an_archive() {
    let (mut meta, files) = by_hand();
    let folder = TempDir::new().unwrap();
    for (name, contents) in &files {
        std::fs::write(folder.path().join(name), contents).unwrap();
    }
    let path = folder.path().join("meta.json");
    std::fs::write(&path, meta.to_string()).unwrap();
    let scene = super::super::read(&path).unwrap();
    let archived = parse(Path::new("scene.sog"), &joined(&meta, files)).unwrap();
    assert_eq!(scene, archived);

    for name in ["../secret", "/etc/passwd", "a/b", "..", "missing.webp"] {
        meta["quats"]["files"][0] = json!(name);
        std::fs::write(&path, meta.to_string()).unwrap();
        let message = read(&path).unwrap_err().to_string();
        assert!(message.contains("quats: "), "{message}");
        assert_eq!(
            message.contains("no name of a file"),
            name != "missing.webp"
        );
    }
}

#[test]
fn every_value_is_as_near_as_its_code() {
    for degree in 0..=3 {
        let mut scene = scene(900, degree);
        scene.settings = SceneSettings {
            scene_scale: Some(2.5),
            antialias: Some(degree % 2 == 1),
            background: Some([0.0, 0.5, 1.0]),
            not_understood: vec![],
        };
        scene.origin = [4e6, -2.5, 0.1];
        let back = round_trip(&scene);
        assert_eq!((back.len(), back.sh_degree), (900, degree));
        assert_eq!(
            (back.origin, &back.settings),
            (scene.origin, &scene.settings)
        );

        let scene = reordered(&scene);
        for axis in 0..3 {
            let logs = scene
                .means
                .iter()
                .map(|mean| mean[axis].abs().ln_1p().copysign(mean[axis]));
            let least = logs.clone().fold(f32::INFINITY, f32::min);
            let most = logs.fold(f32::NEG_INFINITY, f32::max);
            for (mean, found) in scene.means.iter().zip(&back.means) {
                let bound = (most - least) / 65_535.0 / 2.0 * (1.0 + mean[axis].abs()) + 1e-5;
                assert!((mean[axis] - found[axis]).abs() <= bound);
            }
        }
        // Half a step of each of three components goes into the fourth.
        let rotations = rotation_difference(&scene, &back);
        assert!(rotations <= 3.0 * 0.5 / 255.0 * 1.415, "{rotations}");
        let alphas = difference(&opacities(&scene), &opacities(&back));
        assert!(alphas <= 0.5 / 255.0 + 1e-5, "{alphas}");
        // Better than equal steps over the range of the values.
        let root_mean_square = |a: &[f32], b: &[f32]| {
            assert_eq!(a.len(), b.len());
            let squares = a.iter().zip(b).map(|(a, b)| (a - b).powi(2));
            (squares.sum::<f32>() / a.len() as f32).sqrt()
        };
        for (a, b, range) in [
            (&scene.log_scales, &back.log_scales, 8.0),
            (&scene.sh0, &back.sh0, 6.0),
        ] {
            let error = root_mean_square(a.as_flattened(), b.as_flattened());
            assert!(error <= range / 255.0 / 12f32.sqrt(), "{error}");
        }
        if degree > 0 {
            // 512 entries for 900 different Gaussians.
            let error = root_mean_square(&scene.sh_rest, &back.sh_rest);
            assert!(error < 0.45, "{error}");
        }
    }
}

/// The scene in the order of the file.
fn reordered(scene: &SplatData) -> SplatData {
    let order = means::encode(scene).order();
    let rest = scene.sh_rest_len();
    let mut out = scene.clone();
    out.sh_rest.clear();
    for (at, &from) in order.iter().enumerate() {
        let from = from as usize;
        out.means[at] = scene.means[from];
        out.log_scales[at] = scene.log_scales[from];
        out.quats[at] = scene.quats[from];
        out.opacity_logits[at] = scene.opacity_logits[from];
        out.sh0[at] = scene.sh0[from];
        out.sh_rest
            .extend(&scene.sh_rest[from * rest..(from + 1) * rest]);
    }
    out
}

#[test]
fn repeated_harmonics_are_exact() {
    let mut scene = scene(64, 3);
    let one: Vec<f32> = scene.sh_rest[..45].to_vec();
    let two: Vec<f32> = one.iter().map(|x| x / 2.0).collect();
    scene.sh_rest = [one, two].concat().repeat(32);
    let (back, scene) = (round_trip(&scene), reordered(&scene));
    assert!(difference(&scene.sh_rest, &back.sh_rest) < 1e-6);
}

#[test]
fn neighbours_in_space_are_neighbours_in_the_file() {
    let mut scene = scene(4_096, 0);
    for (i, mean) in scene.means.iter_mut().enumerate() {
        // A grid in scrambled order.
        let i = i * 1_677 % 4_096;
        *mean = [i % 16, i / 16 % 16, i / 256].map(|x| x as f32 / 16.0);
    }
    let back = round_trip(&scene);
    let length: f32 = back
        .means
        .windows(2)
        .map(|pair| {
            (0..3)
                .map(|axis| (pair[0][axis] - pair[1][axis]).abs())
                .sum::<f32>()
        })
        .sum();
    // A Morton curve's steps are 2 cells long at most on average.
    assert!(length / 4_095.0 < 2.1 / 16.0, "{length}");
}

#[test]
fn what_is_never_drawn_and_what_is_infinite_stays_so() {
    let mut scene = scene(4, 0);
    scene.opacity_logits = vec![f32::INFINITY, f32::NEG_INFINITY, 3.0, 3.0];
    scene.log_scales[0][1] = f32::NEG_INFINITY;
    scene.quats[2] = [0.0; 4];
    let (back, scene) = (round_trip(&scene), reordered(&scene));
    for at in 0..4 {
        let (logit, found) = (scene.opacity_logits[at], back.opacity_logits[at]);
        match scene.quats[at] == [0.0; 4] {
            true => assert_eq!(found, f32::NEG_INFINITY),
            false if logit.is_infinite() => assert_eq!(found, logit),
            false => assert!((found - logit).abs() < 0.05),
        }
    }
    assert!(back.log_scales.as_flattened().contains(&f32::NEG_INFINITY));

    let mut bad = scene.clone();
    bad.means[3][2] = f32::NAN;
    let message = write("unwritten/scene.sog", &bad).unwrap_err().to_string();
    assert!(message.contains("Gaussian 3: z is NaN"), "{message}");
    let none = SogSettings::new().with_palette(0u32);
    let message = write_with("scene.sog", &scene, &none).unwrap_err();
    assert!(message.to_string().contains("palette is 0"), "{message}");
}

#[test]
fn a_smaller_palette_makes_a_smaller_file() {
    let scene = scene(3_000, 3);
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("scene.sog");
    let mut sizes = vec![];
    for palette in [64u32, 65_536] {
        write_with(&path, &scene, &SogSettings::new().with_palette(palette)).unwrap();
        sizes.push(std::fs::metadata(&path).unwrap().len());
        assert_eq!(read(&path).unwrap().len(), 3_000);
    }
    assert!(sizes[0] < sizes[1] / 2, "{sizes:?}");
    // Written again, a scene is the same file.
    let same = written(&scene);
    assert!(same == written(&scene) && same.len() as u64 == sizes[1]);
}

#[test]
fn damage_is_an_error_that_names_its_place() {
    let good = written(&scene(5, 1));
    for end in (0..good.len()).step_by(7) {
        message_of(&good[..end]);
    }
    let changed = |change: &dyn Fn(&mut Value, &mut NamedFiles), word: &str| {
        let (mut meta, mut files) = by_hand();
        change(&mut meta, &mut files);
        let message = message_of(&joined(&meta, files));
        assert!(message.contains(word), "`{word}`: {message}");
    };
    changed(&|meta, _| meta["version"] = json!(3), "SOG version 3");
    changed(&|meta, _| meta["version"] = Value::Null, "SOG version 1");
    changed(&|meta, _| meta["count"] = json!(0), "holds no Gaussian");
    changed(
        &|meta, _| meta["count"] = json!(5),
        "means: WebP: 4 x 1 pixels do not fit 5",
    );
    changed(
        &|meta, _| meta["count"] = json!(u64::MAX),
        "18446744073709551615 Gaussians in",
    );
    changed(&|meta, _| meta["shN"]["bands"] = json!(4), "shN.bands is 4");
    changed(
        &|meta, _| meta["shN"]["bands"] = json!(2),
        "do not fit a palette",
    );
    changed(
        &|meta, _| meta["shN"]["count"] = json!(65),
        "Gaussian 0: shN: entry 65",
    );
    changed(
        &|meta, _| meta["means"]["files"] = json!([]),
        "means: meta.json names 0",
    );
    changed(
        &|meta, _| meta["means"]["mins"][1] = json!("a"),
        "meta.json: ",
    );
    changed(
        &|meta, _| meta["means"]["maxs"][1] = json!(900.0),
        "Gaussian 1: y is inf",
    );
    changed(
        &|meta, _| meta["scales"]["codebook"][2] = Value::Null,
        "Gaussian 0: scales",
    );
    changed(
        &|meta, _| meta["sh0"]["codebook"] = json!([1]),
        "Gaussian 0: sh0: entry 1",
    );
    changed(
        &|meta, _| meta["quats"]["files"][0] = json!("none"),
        "quats: `none`",
    );
    changed(
        &|meta, _| meta["extras"]["burn_splat"] = json!({"origin": [1]}),
        "extras.burn_splat",
    );
    changed(
        &|meta, _| meta["extras"]["burn_splat"] = json!({"scene_scale": -1}),
        "scene_scale is -1",
    );
    changed(
        &|_, files| files[3].1 = webp(4, 1, &[[0, 0, 0, 251], [0, 0, 0, 252]]),
        "Gaussian 0: quats: alpha is 251",
    );
    changed(&|_, files| files[3].1.truncate(30), "quats: WebP");
    changed(&|_, files| files[4].1 = b"no image".to_vec(), "sh0: WebP");
    let lossy = include_bytes!("../../capture/testdata/lossy.webp");
    let small = image_webp::WebPDecoder::new(std::io::Cursor::new(&lossy[..])).unwrap();
    let (width, height) = small.dimensions();
    changed(
        &move |meta, files| {
            meta["count"] = json!(width * height);
            for file in &mut files[..5] {
                file.1 = lossy.to_vec();
            }
        },
        "means: WebP: lossy",
    );
    assert!(message_of(&archive(&[("a", vec![])])).contains("meta.json"));
    let other = read("Cargo.toml").unwrap_err().to_string();
    assert!(other.contains("no metadata of a SOG scene"), "{other}");
}
