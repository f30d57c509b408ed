//! The `splat` program from a user's view: its results, their reproducibility, and its messages for
//! bad input.
#![cfg(feature = "cpu")]

#[path = "program/files.rs"]
mod files;
#[path = "program/recipes.rs"]
mod recipes;
#[path = "program/runs.rs"]
#[cfg(unix)]
mod runs;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use tempfile::TempDir;

/// The example capture, copied so that a test may corrupt it.
fn example(into: &Path) -> PathBuf {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/data/saharov");
    let target = into.join("capture");
    for folder in ["images", "sparse/0"] {
        fs::create_dir_all(target.join(folder)).unwrap();
        for entry in fs::read_dir(source.join(folder)).unwrap() {
            let entry = entry.unwrap();
            fs::copy(entry.path(), target.join(folder).join(entry.file_name())).unwrap();
        }
    }
    target
}

fn splat(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_splat"))
        .args(["--device", "cpu", "--quiet"])
        .args(arguments)
        .output()
        .unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// A short training run at a quarter of the size.
fn train(capture: &Path, out: &Path, more: &[&str]) -> Output {
    let mut arguments = vec![
        "train",
        text(capture),
        "--out",
        text(out),
        "--downscale",
        "4",
    ];
    arguments.extend(more);
    splat(&arguments)
}

fn metrics(out: &Path) -> serde_json::Value {
    serde_json::from_slice(&fs::read(out.join("metrics.json")).unwrap()).unwrap()
}

fn succeed(output: &Output) {
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
}

#[test]
fn training_leaves_everything_and_repeats_itself_bit_for_bit() {
    let folder = TempDir::new().unwrap();
    let capture = example(folder.path());
    let outs = ["a", "b", "other_seed"].map(|name| folder.path().join(name));
    // 300 steps include the first refinement, so that cloning, splitting and pruning are compared.
    succeed(&train(
        &capture,
        &outs[0],
        &["--steps", "300", "--seed", "7"],
    ));
    succeed(&train(
        &capture,
        &outs[1],
        &["--steps", "300", "--seed", "7"],
    ));
    succeed(&train(
        &capture,
        &outs[2],
        &["--steps", "300", "--seed", "8"],
    ));

    let scenes = outs
        .each_ref()
        .map(|out| fs::read(out.join("scene.ply")).unwrap());
    assert!(scenes[0] == scenes[1], "one seed gave two scenes");
    assert!(scenes[0] != scenes[2], "two seeds gave one scene");
    for file in ["curves.svg", "config.toml", "views"] {
        assert!(outs[0].join(file).exists(), "{file} is missing");
    }
    let metrics = metrics(&outs[0]);
    assert_eq!(metrics["views"].as_array().unwrap().len(), 4);
    assert_eq!(metrics["steps"], 300);
    // It learns: far better on held-out views than at the start.
    let begun = folder.path().join("begun");
    succeed(&train(&capture, &begun, &["--steps", "1", "--seed", "7"]));
    let begun = self::metrics(&begun)["psnr"].as_f64().unwrap();
    let psnr = metrics["psnr"].as_f64().unwrap();
    assert!(
        psnr > begun + 2.0,
        "{begun} dB after a step, {psnr} dB after 300"
    );

    let scene = outs[0].join("scene.ply");
    let evaluated = splat(&["eval", text(&capture), text(&scene), "--downscale", "4"]);
    succeed(&evaluated);
    let table = String::from_utf8_lossy(&evaluated.stdout).into_owned();
    assert!(table.contains(&format!("{psnr:.3}")), "{table}");
    succeed(&splat(&["info", text(&scene)]));
    succeed(&splat(&["info", text(&capture)]));
}

/// Bad input: exit status 2, one line that contains these words, and no output folder.
fn refused(output: &Output, out: &Path, words: &[&str]) {
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert_eq!(errors.trim_end().lines().count(), 1, "{errors}");
    for word in words {
        assert!(errors.contains(word), "`{word}` is not in: {errors}");
    }
    assert!(!out.exists(), "something was written");
}

/// Random points take the place of missing ones, with a word.
#[test]
fn a_capture_without_points_is_trained() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("out");
    let capture = example(folder.path());
    fs::remove_file(capture.join("sparse/0/points3D.bin")).unwrap();
    let output = train(&capture, &out, &["--steps", "1", "--hold-out", "16"]);
    succeed(&output);
    let info = splat(&["info", text(&capture)]);
    succeed(&info);
    let said = String::from_utf8_lossy(&info.stdout).into_owned();
    assert!(
        said.contains("warning: ") && said.contains("random"),
        "{said}"
    );
    assert_eq!(metrics(&out)["gaussians"], 100_000);
    assert_eq!(metrics(&out)["views"].as_array().unwrap().len(), 2);
}

/// Refined cameras and undistorted photos are captures like any other.
#[test]
fn cameras_are_refined_and_written() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("out");
    let capture = example(folder.path());
    let flags = [
        "--steps",
        "5",
        "--refine-poses",
        "--refine-intrinsics",
        "--undistort",
    ];
    succeed(&train(&capture, &out, &flags));
    let aligned = metrics(&out)["aligned"]["psnr"].as_f64().unwrap();
    assert!(aligned > 5.0, "{aligned}");
    let refined = splat(&["info", text(&out.join("undistorted"))]);
    succeed(&refined);
    let said = String::from_utf8_lossy(&refined.stdout).into_owned();
    assert!(said.contains("pinhole  fx"), "{said}");
    let images = capture.join("images");
    let cameras = out.join("cameras");
    let refined = splat(&["info", text(&cameras), "--images", text(&images)]);
    succeed(&refined);
    let said = String::from_utf8_lossy(&refined.stdout).into_owned();
    assert!(
        said.contains("opencv  fx") && said.contains("  k1 "),
        "{said}"
    );
    // The run's figures are those of its own cameras, and others are used with a warning.
    let eval = |capture: &Path, more: &[&str]| {
        let json = folder.path().join("scores.json");
        let scene = out.join("scene.ply");
        let words = [
            &["--device", "cpu", "eval", text(capture), text(&scene)][..],
            &["--downscale", "4", "--json", text(&json)],
            more,
        ];
        let mut program = Command::new(env!("CARGO_BIN_EXE_splat"));
        let output = program.args(words.concat()).output().unwrap();
        succeed(&output);
        let scores: serde_json::Value =
            serde_json::from_str(&fs::read_to_string(json).unwrap()).unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        (scores["psnr"].as_f64().unwrap(), said)
    };
    let (by_refined, said) = eval(&capture, &["--cameras", text(&cameras)]);
    assert!(!said.contains("warning"), "{said}");
    assert!(
        (by_refined - aligned).abs() < 1e-3,
        "{by_refined} for {aligned}"
    );
    let (_, said) = eval(&out.join("undistorted"), &[]);
    assert!(!said.contains("--cameras"), "{said}");
    let (by_own, said) = eval(&capture, &[]);
    let advice = format!("add --cameras {}", text(&cameras));
    assert!(said.contains(&advice) && by_own != by_refined, "{said}");
    // Refined cameras are replaced with the scene that they belong to.
    let refined = ["--steps", "5", "--refine-intrinsics"];
    succeed(&train(&capture, &out, &refined));
    assert!(cameras.join("cameras.bin").exists());
    // They are not replaced by the run that reads them.
    let own = train(
        &capture,
        &out,
        &["--steps", "5", "--cameras", text(&cameras)],
    );
    assert_eq!(own.status.code(), Some(2));
    let errors = String::from_utf8_lossy(&own.stderr).into_owned();
    assert!(errors.contains("cameras: the command reads it"), "{errors}");
    assert!(cameras.join("cameras.bin").exists());
    let other = folder.path().join("other");
    let elsewhere = ["--steps", "5", "--cameras", text(&cameras)];
    succeed(&train(&capture, &other, &elsewhere));
    succeed(&train(&capture, &out, &["--steps", "5"]));
    assert!(!cameras.join("cameras.bin").exists());
    // Undistorted photos are not replaced.
    let again = train(&capture, &out, &flags);
    assert_eq!(again.status.code(), Some(2));
    let errors = String::from_utf8_lossy(&again.stderr).into_owned();
    assert!(errors.contains("undistorted: there already"), "{errors}");
}

#[test]
fn bad_captures_are_refused_in_one_line() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("out");
    let missing = folder.path().join("nowhere");
    refused(&train(&missing, &out, &[]), &out, &["nowhere"]);

    let capture = example(folder.path());
    let model = capture.join("sparse/0/images.bin");
    let whole = fs::read(&model).unwrap();
    fs::write(&model, &whole[..whole.len() / 2]).unwrap();
    refused(&train(&capture, &out, &[]), &out, &["images.bin"]);
    fs::write(&model, &whole).unwrap();

    let photos: Vec<_> = fs::read_dir(capture.join("images")).unwrap().collect();
    let photo = photos[3].as_ref().unwrap().path();
    let kept = fs::read(&photo).unwrap();
    fs::remove_file(&photo).unwrap();
    let name = photo.file_name().unwrap().to_str().unwrap();
    refused(&train(&capture, &out, &[]), &out, &[name]);
    fs::write(&photo, kept).unwrap();

    let points = capture.join("sparse/0/points3D.bin");
    let kept = fs::read(&points).unwrap();
    fs::write(&points, 9u64.to_le_bytes()).unwrap();
    refused(
        &train(&capture, &out, &[]),
        &out,
        &["points3D.bin", "point"],
    );
    fs::write(&points, kept).unwrap();

    // At 1 x 1 pixel nothing can be compared.
    let tiny = splat(&[
        "train",
        text(&capture),
        "--out",
        text(&out),
        "--downscale",
        "317",
    ]);
    refused(&tiny, &out, &["1x1"]);
    refused(&train(&capture, &out, &["--steps", "0"]), &out, &["steps"]);
    refused(
        &train(&capture, &out, &["--sh-degree", "4"]),
        &out,
        &["sh_degree"],
    );
}

#[test]
fn bad_scenes_are_refused_in_one_line() {
    let folder = TempDir::new().unwrap();
    let out = folder.path().join("out");
    let scene = folder.path().join("nan.ply");
    let properties = [
        "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
        "rot_0", "rot_1", "rot_2", "rot_3",
    ];
    let header: String = properties
        .iter()
        .map(|p| format!("property float {p}\n"))
        .collect();
    let row = |x: &str| format!("{x} 0 0 0 0 0 0 0 0 0 1 0 0 0\n");
    let file = format!(
        "ply\nformat ascii 1.0\nelement vertex 2\n{header}end_header\n{}{}",
        row("1"),
        row("nan")
    );
    fs::write(&scene, file).unwrap();
    refused(
        &splat(&["info", text(&scene)]),
        &out,
        &["nan.ply", "1", "x"],
    );
    fs::write(&scene, "no splats here").unwrap();
    refused(&splat(&["info", text(&scene)]), &out, &["nan.ply"]);
}

#[test]
fn benches_of_speed_leave_their_figures() {
    let folder = TempDir::new().unwrap();
    let capture = example(folder.path());
    let json = folder.path().join("figures.json");
    let svg = folder.path().join("picture.svg");
    let figures = |arguments: &[&str]| -> serde_json::Value {
        let output = splat(&[&["bench"], arguments, &["--json", text(&json)]].concat());
        succeed(&output);
        assert!(String::from_utf8_lossy(&output.stdout).contains("median ms"));
        serde_json::from_slice(&fs::read(&json).unwrap()).unwrap()
    };
    let small = ["--downscale", "16", "--seconds", "0"];

    let step = figures(&[&["step", text(&capture), "--svg", text(&svg)], &small[..]].concat());
    let rows = step["rows"].as_array().unwrap();
    for degree in [0, 3] {
        let row = rows.iter().find(|row| row["sh_degree"] == degree).unwrap();
        assert_eq!(row["steps"], 20);
        assert!(row["milliseconds"]["median"].as_f64().unwrap() > 0.0);
        let stages = row["stages"].as_array().unwrap();
        assert!(stages.iter().any(|stage| stage[0] == "rasterize gradient"));
        assert_eq!(stages.last().unwrap()[0], "rest (Burn and the trainer)");
    }
    let picture = fs::read_to_string(&svg).unwrap();
    assert!(picture.contains("rasterize gradient") && picture.contains("</svg>"));

    let rasterize = figures(&[&["rasterize", text(&capture)], &small[..]].concat());
    assert_eq!(rasterize["work"]["views"], 8);
    assert!(rasterize["rows"][0]["lists"]["median"].as_f64().unwrap() > 0.0);
    for direction in ["forward", "backward"] {
        let rate = &rasterize["rows"][0][direction]["tested_per_second"];
        assert!(rate.as_f64().unwrap() > 0.0, "{rasterize}");
    }

    let scaling = figures(&[
        "scaling",
        "--gaussians",
        "200,2000",
        "--pixels",
        "3000,12000,48000",
        "--svg",
        text(&svg),
    ]);
    let points = scaling["points"].as_array().unwrap();
    assert_eq!(points.len(), 6);
    assert_eq!(points[1]["work"]["gaussians"], 2000);
    assert_eq!(points[5]["work"]["pixels"], 48070.0);
    if cfg!(target_os = "linux") {
        assert!(points[0]["peak_rss_bytes"].as_u64().unwrap() > 1_000_000);
        assert!(scaling["memory"]["per_gaussian"].as_f64().unwrap() >= 0.0);
    }
    assert!(fs::read_to_string(&svg).unwrap().contains("2k Gaussians"));

    // The same capture, from files.
    let synthetic = folder.path().join("synthetic");
    succeed(&splat(&[
        "bench",
        "capture",
        "2000",
        "3000",
        "--out",
        text(&synthetic),
    ]));
    let step = figures(&["step", text(&synthetic), "--seconds", "0"]);
    assert_eq!(step["work"], points[1]["work"]);
}

#[test]
#[cfg(feature = "wgpu")]
fn benches_of_speed_measure_a_device_too() {
    let folder = TempDir::new().unwrap();
    let json = folder.path().join("figures.json");
    let figures = |arguments: &[&str]| -> Option<serde_json::Value> {
        let output = Command::new(env!("CARGO_BIN_EXE_splat"))
            .args(["--device", "wgpu", "--quiet", "bench"])
            .args(arguments)
            .args(["--json", text(&json)])
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        let found = !said.contains("no adapter can be used");
        splat_test_support::adapter_or_skip(found.then_some(()).ok_or(said))?;
        succeed(&output);
        Some(serde_json::from_slice(&fs::read(&json).unwrap()).unwrap())
    };
    let capture = example(folder.path());
    let small = ["--downscale", "16", "--seconds", "0"];
    let Some(rasterize) = figures(&[&["rasterize", text(&capture)], &small[..]].concat()) else {
        return;
    };
    let row = &rasterize["rows"][0];
    let median = |name: &str| row[name]["median"].as_f64().unwrap();
    assert!(median("render_forward_milliseconds") > 0.0);
    assert!(median("render_backward_milliseconds") > 0.0);
    for rate in ["forward", "backward", "backward_unordered"] {
        assert!(row[rate]["tested_per_second"].as_f64().unwrap() > 0.0);
    }
    // For one pass, the ratio is that of its two times.
    let [ordered, unordered] = ["backward", "backward_unordered"]
        .map(|name| row[name]["milliseconds"]["median"].as_f64().unwrap());
    let ratio = median("cost_of_order") * unordered / ordered;
    assert!(row["passes"] != 1 || (ratio - 1.0).abs() < 1e-9, "{row}");
    let facts = rasterize["device"].as_array().unwrap();
    assert!(facts.iter().any(|fact| fact[0] == "planes"), "{facts:?}");

    let scaling = figures(&["scaling", "--gaussians", "300", "--pixels", "64x36"]).unwrap();
    let point = &scaling["points"][0];
    assert_eq!(point["work"]["pixels"], 64.0 * 36.0);
    let memory = &point["device_memory"];
    let bytes = |name: &str| memory[name].as_u64().unwrap();
    assert!(bytes("at_rest_bytes") >= 300 * 716, "{memory}");
    assert!(bytes("most_bytes") > bytes("at_rest_bytes"));
}

#[test]
fn benches_refuse_what_they_cannot_measure_in_one_line() {
    let folder = TempDir::new().unwrap();
    let nowhere = folder.path().join("nowhere");
    let file = folder.path().join("file");
    fs::write(&file, []).unwrap();
    let bad: [(&[&str], &str); 7] = [
        (&["step", text(&nowhere)], "nowhere"),
        (&["rasterize", "a.ply"], "--capture"),
        (&["step", text(&nowhere), "--downscale", "0"], "downscale"),
        (&["scaling", "--gaussians", "10,0"], "--gaussians"),
        (&["capture", "0", "9x5", "--out", "a"], "GAUSSIANS"),
        (&["capture", "9", "9x5", "--out", text(&file)], text(&file)),
        (&["performance", "--device", "wgpu"], "--device"),
    ];
    for (arguments, named) in bad {
        let output = Command::new(env!("CARGO_BIN_EXE_splat"))
            .arg("bench")
            .args(arguments)
            .output()
            .unwrap();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{errors}");
        assert!(errors.contains(named), "{arguments:?}: {errors}");
        assert_eq!(errors.trim_end().lines().count(), 1, "{errors}");
    }
}

/// As in `splat ... 2>&1 | head -1`.
#[test]
fn that_nobody_reads_what_is_said_ends_nothing() {
    let fixture = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../tests/fixtures/one_gaussian.safetensors"
    );
    for (arguments, status) in [
        (["gradcheck", fixture], 0),
        (["gradcheck", "no such file"], 2),
    ] {
        let mut child = Command::new(env!("CARGO_BIN_EXE_splat"))
            .args(["--device", "cpu"])
            .args(arguments)
            .stdout(std::process::Stdio::null())
            .stderr(std::process::Stdio::piped())
            .spawn()
            .unwrap();
        drop(child.stderr.take());
        assert_eq!(child.wait().unwrap().code(), Some(status), "{arguments:?}");
    }
}
