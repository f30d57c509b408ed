//! Runs that are interrupted, resumed, overwritten, or cannot be saved.

use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

use super::*;

/// The example capture at an eighth of its size.
const SMALL: [&str; 2] = ["--downscale", "8"];
/// Files of a complete run, besides `views`.
const RESULTS: [&str; 5] = [
    "scene.ply",
    "config.toml",
    "metrics.json",
    "losses.csv",
    "curves.svg",
];

/// `splat --device cpu train` with these arguments, run in the folder of `capture`, where it writes
/// `out`.
fn training(capture: &Path, out: &str, more: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_splat"));
    command
        .current_dir(capture.parent().unwrap())
        .args(["--device", "cpu", "train"])
        .arg(capture.file_name().unwrap())
        .arg(format!("--out={out}"))
        .args(more);
    command
}

fn small_run(capture: &Path, out: &str, more: &[&str]) -> Output {
    training(capture, out, &[&SMALL[..], more].concat())
        .output()
        .unwrap()
}

/// The command under a file size limit, to simulate a full disk.
fn limited(command: &Command, bytes: u64) -> Command {
    let script = format!("ulimit -f {}; exec \"$0\" \"$@\"", bytes / 512);
    let mut limited = Command::new("sh");
    limited
        .current_dir(command.get_current_dir().unwrap())
        .args(["-c", &script])
        .arg(command.get_program())
        .args(command.get_args());
    limited
}

/// Waits for a condition.
fn wait_for(what: &str, is_so: impl Fn() -> bool) {
    let start = Instant::now();
    while !is_so() {
        assert!(start.elapsed() < Duration::from_secs(120), "no {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Ctrl-C.
fn interrupt(child: &Child) {
    let pid = child.id().to_string();
    let kill = Command::new("kill").args(["-INT", &pid]).status();
    assert!(kill.unwrap().success());
}

/// Interrupts a run after its first checkpoint; returns its messages.
fn interrupted(capture: &Path, out: &str, more: &[&str]) -> String {
    let endless = ["--steps", "100000", "--autosave", "0"];
    let child = training(capture, out, &[&SMALL[..], &endless, more].concat())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let file = capture.with_file_name(out).join("checkpoint.safetensors");
    wait_for("checkpoint", || file.exists());
    interrupt(&child);
    let output = child.wait_with_output().unwrap();
    succeed(&output);
    stderr(&output)
}

/// Files of a folder with their contents, excluding subfolders.
fn contents(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let entries = fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    let files = entries.filter(|path| path.is_file());
    let mut files: Vec<_> = files
        .map(|path| (path.clone(), fs::read(path).unwrap()))
        .collect();
    files.sort();
    files
}

/// Bad input is reported in one line with these words, and `folder` is unchanged.
fn refused_without_loss(
    output: &Output,
    before: &[(PathBuf, Vec<u8>)],
    folder: &Path,
    words: &[&str],
) {
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{errors}");
    let line = errors.trim_end().lines().last().unwrap();
    for word in words {
        assert!(line.contains(word), "`{word}` is not in: {line}");
    }
    assert!(contents(folder) == before, "files changed: {line}");
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// The printed command resumes the run, whatever the paths are called.
#[test]
fn the_printed_commands_work_when_pasted() {
    let folder = TempDir::new().unwrap();
    let capture = folder.path().join("it's my \"$HOME\" capture");
    fs::rename(example(folder.path()), &capture).unwrap();
    let out = "-o u't";
    let said = interrupted(&capture, out, &["--seed", "5", "--refine-intrinsics"]);
    let left = folder.path().join(out);
    for file in [
        "scene.ply",
        "checkpoint.safetensors",
        "config.toml",
        "losses.csv",
        "cameras/cameras.bin",
    ] {
        assert!(left.join(file).is_file(), "no {file}");
    }
    let (_, words) = said.split_once("stopped after ").unwrap();
    let done: usize = words.split_once(' ').unwrap().0.parse().unwrap();
    let (_, command) = words.split_once("to go on: ").unwrap();

    let paste = |command: &str| {
        let program = Path::new(env!("CARGO_BIN_EXE_splat"));
        let path = std::env::var("PATH").unwrap();
        Command::new("sh")
            .current_dir(folder.path())
            .env(
                "PATH",
                format!("{}:{path}", program.parent().unwrap().display()),
            )
            .args(["-c", command])
            .output()
            .unwrap()
    };
    let output = paste(&format!("{} --steps {}", command.trim_end(), done + 3));
    succeed(&output);
    let metrics = metrics(&left);
    assert_eq!(metrics["steps"], done + 3);
    assert_eq!(metrics["seed"], 5);
    assert!(!left.join("checkpoint.safetensors").exists());
    // It differs from an uninterrupted run of that many steps, and says so.
    assert!(
        stderr(&output).contains("cannot be repeated"),
        "{}",
        stderr(&output)
    );
    let config = fs::read_to_string(left.join("config.toml")).unwrap();
    assert!(
        config.contains("# not of the whole run: from step"),
        "{config}"
    );

    // A name with a line break does not leak into the settings.
    let broken = "a\nseed = 1\nb";
    succeed(&small_run(
        &capture,
        broken,
        &["--steps", "1", "--seed", "3"],
    ));
    let config_of_broken = folder.path().join(broken).join("config.toml");
    let again = ["--config", text(&config_of_broken)];
    succeed(&small_run(&capture, "again", &again));
    assert_eq!(self::metrics(&folder.path().join("again"))["seed"], 3);

    let scene = || fs::read(left.join("scene.ply")).unwrap();
    let (_, repeat) = config.split_once("to repeat: ").unwrap();
    let repeat = repeat.lines().next().unwrap();
    succeed(&paste(repeat));
    let first = scene();
    succeed(&paste(repeat));
    assert!(scene() == first);
}

// Longer than a hundred lines, as it follows one run from start to end.
#[test]
fn a_run_is_gone_on_with_as_it_was_begun_or_not_at_all() {
    let folder = TempDir::new().unwrap();
    let capture = example(folder.path());
    interrupted(&capture, "out", &["--seed", "7"]);
    let out = folder.path().join("out");
    let before = contents(&out);
    let resume = |capture: &Path, given: &str, more: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_splat"))
            .current_dir(folder.path())
            .args(["--device", "cpu", "train", text(capture), "--resume", given])
            .args(more)
            .output()
            .unwrap()
    };
    let refused = |output: Output, words: &[&str]| {
        refused_without_loss(&output, &before, &out, words);
    };

    // Fewer steps than are done leave nothing to train.
    refused(
        resume(&capture, "out", &["--steps", "1"]),
        &["steps are done", "ask for more"],
    );
    for (setting, words) in [
        (["--seed", "8"], "seed = 7, not 8"),
        (["--downscale", "4"], "downscale = 8, not 4"),
        (["--sh-degree", "1"], "init.sh_degree = 3, not 1"),
    ] {
        refused(
            resume(&capture, "out", &setting),
            &[words, "leave that out"],
        );
    }
    // The same capture with one number of one camera changed, another split, or one photo fewer.
    let model = capture.join("sparse/0/images.bin");
    let whole = fs::read(&model).unwrap();
    let mut moved = whole.clone();
    moved[44] ^= 1;
    fs::write(&model, moved).unwrap();
    refused(
        resume(&capture, "out", &[]),
        &["another capture", "another camera"],
    );
    fs::write(&model, whole).unwrap();
    let names: Vec<String> = fs::read_dir(capture.join("images"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    let split = capture.join("split.json");
    fs::write(
        &split,
        serde_json::json!({"train": names, "test": []}).to_string(),
    )
    .unwrap();
    refused(
        resume(&capture, "out", &[]),
        &["another capture", "it was held out"],
    );
    fs::remove_file(&split).unwrap();

    // Inputs that are no run to resume.
    refused(
        resume(&capture, "nowhere", &[]),
        &["nowhere", "no such folder"],
    );
    refused(
        resume(&capture, "out/scene.ply", &[]),
        &["scene.ply", "a scene alone"],
    );
    refused(
        resume(&capture, "out/config.toml", &[]),
        &["config.toml", "--config"],
    );
    refused(
        resume(&capture, "capture", &[]),
        &["capture", "checkpoint.safetensors"],
    );
    let old = folder.path().join("old.safetensors");
    let header = r#"{"__metadata__":{"burn_splat":"{\"version\":2,\"step\":9}"}}"#;
    let header = [&(header.len() as u64).to_le_bytes()[..], header.as_bytes()].concat();
    fs::write(&old, header).unwrap();
    refused(
        resume(&capture, "old.safetensors", &[]),
        &["version 2", "begin the run again"],
    );

    // Nor may another run start in its place.
    refused(
        small_run(&capture, "out", &["--steps", "2"]),
        &["checkpoint.safetensors", "--resume"],
    );
    succeed(&small_run(&capture, "done", &["--steps", "2"]));
    refused(resume(&capture, "done", &[]), &["done", "complete"]);
    let elsewhere = resume(&capture, "out", &["--out", "done", "--seed", "8"]);
    refused(elsewhere, &["seed = 7, not 8"]);

    // The checkpoint file works as well as its folder; edited settings beside it are not those of
    // the run.
    fs::write(out.join("config.toml"), "seed = 9").unwrap();
    let more = ["--steps", "100", "--max-gaussians", "10"];
    let output = resume(&capture, "out/checkpoint.safetensors", &more);
    succeed(&output);
    let said = stderr(&output);
    for words in [
        "config.toml is not read",
        "--max-gaussians 10 is below the",
        "steps = 100, before",
    ] {
        assert!(said.contains(words), "no `{words}` in {said}");
    }
    assert_eq!(metrics(&out)["seed"], 7);
    assert!(!out.join("checkpoint.safetensors").exists());
}

/// Unwritable outputs are reported before the first step, and nothing else is in the folder then.
#[test]
fn the_folder_is_tried_before_the_first_step() {
    let folder = TempDir::new().unwrap();
    let capture = example(folder.path());
    fs::write(folder.path().join("file"), "kept").unwrap();
    for name in ["scene.ply", "metrics.json", "checkpoint.safetensors"] {
        let out = folder.path().join(format!("with {name}"));
        fs::create_dir_all(out.join(name).join("inside")).unwrap();
        let output = small_run(&capture, text(&out), &["--steps", "2"]);
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.contains(name), "{said}");
        assert_eq!(fs::read_dir(&out).unwrap().count(), 1, "{said}");
    }
    let below = small_run(&capture, "file/below", &["--steps", "2"]);
    assert_eq!(below.status.code(), Some(2));
    assert!(stderr(&below).contains("file/below: a file is in the place of a folder"));

    let out = folder.path().join("views");
    fs::create_dir_all(&out).unwrap();
    fs::write(out.join("views"), "kept").unwrap();
    let output = small_run(&capture, "views", &["--steps", "2"]);
    assert_eq!(output.status.code(), Some(2));
    assert_eq!(fs::read_dir(&out).unwrap().count(), 1);

    // Figures are checked too, before the views are rendered: the table comes with them.
    succeed(&small_run(&capture, "done", &["--steps", "2"]));
    let scene = folder.path().join("done/scene.ply");
    let json = text(folder.path());
    let output = splat(&[
        "eval",
        text(&capture),
        text(&scene),
        "--downscale",
        "8",
        "--json",
        json,
    ]);
    assert_eq!(output.status.code(), Some(2));
    assert!(output.stdout.is_empty() && stderr(&output).contains("a folder is in the place"));
}

/// The scene is smaller than the checkpoint, and is saved first.
#[test]
fn a_full_disk_takes_no_more_than_it_must() {
    let folder = TempDir::new().unwrap();
    let capture = example(folder.path());
    let steps = ["--steps", "6"];
    succeed(&small_run(&capture, "whole", &steps));
    let whole = folder.path().join("whole");
    let scene = fs::metadata(whole.join("scene.ply")).unwrap().len();

    // Room for a scene, not for a checkpoint.
    let run = training(&capture, "no_autosave", &[&SMALL[..], &steps].concat());
    succeed(&limited(&run, scene * 5 / 4).output().unwrap());
    // Every autosave fails, and is reported once.
    let run = training(
        &capture,
        "scene",
        &[&SMALL[..], &steps, &["--autosave", "0"]].concat(),
    );
    let output = limited(&run, scene * 5 / 4).output().unwrap();
    succeed(&output);
    let said = stderr(&output);
    assert_eq!(said.matches("could not be saved").count(), 1, "{said}");
    assert!(
        said.contains("checkpoint.safetensors: File too large"),
        "{said}"
    );
    let read = |out: &str, file: &str| fs::read(folder.path().join(out).join(file));
    assert!(read("scene", "scene.ply").unwrap() == read("whole", "scene.ply").unwrap());
    for file in RESULTS {
        assert!(read("scene", file).is_ok(), "no {file}");
    }

    // No room for a scene beside that of another run: nothing of this run is written there.
    let of_before = || RESULTS.map(|file| read("whole", file).unwrap());
    let before = of_before();
    let run = training(&capture, "whole", &[&SMALL[..], &["--steps", "7"]].concat());
    let output = limited(&run, scene / 2).output().unwrap();
    assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
    assert!(of_before() == before);

    // Interrupted: the scene is saved, and the message says that the checkpoint is not.
    let endless = ["--steps", "100000", "--autosave", "0"];
    let run = training(&capture, "stopped", &[&SMALL[..], &endless].concat());
    let log = folder.path().join("log");
    let mut child = limited(&run, scene * 5 / 4)
        .stderr(fs::File::create(&log).unwrap())
        .spawn()
        .unwrap();
    wait_for("warning", || {
        fs::read_to_string(&log)
            .unwrap()
            .contains("could not be saved")
    });
    interrupt(&child);
    let status = child.wait().unwrap();
    let said = fs::read_to_string(&log).unwrap();
    assert_eq!(status.code(), Some(2), "{said}");
    let last = said.trim_end().lines().last().unwrap();
    assert!(
        last.contains("not saved: checkpoint.safetensors; saved: scene.ply, config.toml"),
        "{last}"
    );
    assert!(read("stopped", "scene.ply").is_ok());

    // Room for neither: everything else is saved, and the exit status says so.
    let run = training(&capture, "none", &[&SMALL[..], &steps].concat());
    let output = limited(&run, scene / 2).output().unwrap();
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(2), "{said}");
    let last = said.trim_end().lines().last().unwrap();
    for words in [
        "scene.ply: File too large",
        "not saved: scene.ply, checkpoint.safetensors",
        "metrics.json",
    ] {
        assert!(last.contains(words), "no `{words}` in {last}");
    }
    for file in [
        "config.toml",
        "metrics.json",
        "losses.csv",
        "curves.svg",
        "views",
    ] {
        assert!(folder.path().join("none").join(file).exists(), "no {file}");
    }
    assert!(read("none", "scene.ply").is_err());
}

/// If a result cannot be saved after the last step, the checkpoint is kept, and resuming saves the
/// rest.
#[test]
fn a_run_whose_results_could_not_be_saved_is_finished_later() {
    let folder = TempDir::new().unwrap();
    let capture = example(folder.path());
    let out = folder.path().join("out");
    let more = [&SMALL[..], &["--steps", "60", "--autosave", "0"]].concat();
    let child = training(&capture, "out", &more)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    wait_for("checkpoint", || out.join("checkpoint.safetensors").exists());
    // After the check of the folder.
    fs::write(out.join("views"), "in the way").unwrap();
    let output = child.wait_with_output().unwrap();
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(2), "{said}");
    let last = said.trim_end().lines().last().unwrap();
    for words in [
        "views",
        "not saved: views; saved: scene.ply",
        "--resume out",
    ] {
        assert!(last.contains(words), "no `{words}` in {last}");
    }
    let scene = fs::read(out.join("scene.ply")).unwrap();
    // The scores are not lost either.
    assert!(String::from_utf8_lossy(&output.stdout).contains("mean"));

    fs::remove_file(out.join("views")).unwrap();
    let resumed = Command::new(env!("CARGO_BIN_EXE_splat"))
        .current_dir(folder.path())
        .args(["--device", "cpu", "train", "capture", "--resume", "out"])
        .output()
        .unwrap();
    succeed(&resumed);
    assert!(fs::read(out.join("scene.ply")).unwrap() == scene);
    assert_eq!(metrics(&out)["steps"], 60);
    assert_eq!(fs::read_dir(out.join("views")).unwrap().count(), 4);
    assert!(!out.join("checkpoint.safetensors").exists());
}

/// The scene's file determines how it is rendered, whatever is beside it.
#[test]
fn a_scenes_settings_stay_with_the_scene() {
    let folder = TempDir::new().unwrap();
    let capture = example(folder.path());
    let config = folder.path().join("settings.toml");
    // With a byte-order mark, as some editors write.
    fs::write(
        &config,
        "\u{FEFF}antialias = true\nbackground = [1.0, 0.5, 0.0]\n",
    )
    .unwrap();
    let steps = ["--steps", "2"];
    let more = [&steps[..], &["--config", text(&config)]].concat();
    succeed(&small_run(&capture, "out", &more));
    let out = folder.path().join("out");
    let first = out.join("first.ply");
    fs::copy(out.join("scene.ply"), &first).unwrap();
    let psnr = metrics(&out)["psnr"].as_f64().unwrap();
    let eval = |scene: &Path| {
        let arguments = ["eval", text(&capture), text(scene), "--downscale", "8"];
        let output = Command::new(env!("CARGO_BIN_EXE_splat"))
            .args(["--device", "cpu"])
            .args(arguments)
            .output()
            .unwrap();
        succeed(&output);
        let table = String::from_utf8_lossy(&output.stdout).into_owned();
        (table, stderr(&output))
    };
    let (table, _) = eval(&first);
    assert!(table.contains(&format!("{psnr:.3}")), "{table}");
    // A run with other settings reports what it replaces.
    let output = small_run(&capture, "out", &steps);
    succeed(&output);
    assert_eq!(eval(&first).0, table);
    assert!(stderr(&output).contains("out: the results of an earlier run are replaced"));
    fs::remove_file(out.join("config.toml")).unwrap();
    assert_eq!(eval(&first).0, table);

    // For a scene that does not say, its config.toml is read; one that does not belong to a run is
    // ignored with a message.
    let bytes = fs::read(&first).unwrap();
    let silent = String::from_utf8_lossy(&bytes[..600]).into_owned();
    let end = silent.find("element").unwrap();
    let start = silent.find("comment").unwrap();
    let old = out.join("old.ply");
    fs::write(&old, [&bytes[..start], &bytes[end..]].concat()).unwrap();
    let (without, said) = eval(&old);
    assert!(without != table && !said.contains("config.toml"), "{said}");
    fs::copy(&config, out.join("config.toml")).unwrap();
    let (with, said) = eval(&old);
    assert_eq!(with, table);
    assert!(said.contains("config.toml beside the scene says"), "{said}");
    fs::write(out.join("config.toml"), "[package]\nname = \"other\"\n").unwrap();
    let (with, said) = eval(&old);
    assert_eq!(with, without);
    assert!(
        said.contains("passed over") && said.contains("package"),
        "{said}"
    );
}

/// Figures of an earlier scene are removed, and its pictures are reported.
#[test]
fn results_of_two_runs_are_not_mixed_up() {
    let folder = TempDir::new().unwrap();
    let capture = example(folder.path());
    let output = small_run(&capture, "out", &["--steps", "2", "--max-gaussians", "5"]);
    succeed(&output);
    assert!(
        stderr(&output).contains("--max-gaussians 5 is below the"),
        "{}",
        stderr(&output)
    );
    let out = folder.path().join("out");
    let photos = fs::read_dir(out.join("views")).unwrap().count();
    assert_eq!(photos, 4);
    let names: Vec<String> = metrics(&out)["views"]
        .as_array()
        .unwrap()
        .iter()
        .map(|view| view["name"].as_str().unwrap().to_owned())
        .collect();
    let mut all: Vec<String> = fs::read_dir(capture.join("images"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    all.retain(|name| *name != names[0]);
    let split = serde_json::json!({"train": all, "test": [names[0]]});
    fs::write(capture.join("split.json"), split.to_string()).unwrap();
    let output = small_run(&capture, "out", &["--steps", "2"]);
    succeed(&output);
    assert_eq!(metrics(&out)["views"].as_array().unwrap().len(), 1);
    let said = stderr(&output);
    assert!(said.contains("3 picture(s) were there before"), "{said}");

    // Until a run is interrupted or ends, existing files stay unchanged.
    let said = interrupted(&capture, "out", &[]);
    assert!(said.contains("4 picture(s) were there before"), "{said}");
    assert!(!out.join("metrics.json").exists());
}

#[test]
fn lowered_degrees_are_reported_and_the_scene_has_zeros() {
    let folder = TempDir::new().unwrap();
    let capture = example(folder.path());
    let config = folder.path().join("lower.toml");
    // Every colour varies by less.
    fs::write(&config, "[sh_reduction]\nstd = 1e9\n").unwrap();
    let out = folder.path().join("out");
    let trained = train(
        &capture,
        &out,
        &["--steps", "100", "--config", text(&config)],
    );
    succeed(&trained);
    let said = String::from_utf8_lossy(&trained.stdout).into_owned();
    assert!(said.contains("spherical harmonics"), "{said}");
    let reduced = &metrics(&out)["sh_reduction"];
    assert!(reduced["step"].as_u64().unwrap() >= 50, "{reduced}");
    let lowered: Vec<u64> = serde_json::from_value(reduced["gaussians"].clone()).unwrap();
    assert!(lowered[0] > 0 && lowered[1..] == [0, 0, 0], "{reduced}");
    let kept = fs::read_to_string(out.join("config.toml")).unwrap();
    assert!(kept.contains("[sh_reduction]"), "{kept}");

    let scene = out.join("scene.ply");
    let json = folder.path().join("scores.json");
    let scored = splat(
        &[
            &["eval", text(&capture), text(&scene)][..],
            &["--downscale", "4", "--json", text(&json)],
        ]
        .concat(),
    );
    succeed(&scored);
    let scores: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(json).unwrap()).unwrap();
    let [found, expected] = [&scores, &metrics(&out)].map(|of| of["psnr"].as_f64().unwrap());
    assert!((found - expected).abs() < 1e-3, "{found} for {expected}");
}
