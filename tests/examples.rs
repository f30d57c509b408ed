//! Every example runs, at its smallest size, and leaves a picture in which every part shows
//! something. `scripts/examples` runs them whole.

use std::collections::HashSet;
use std::env::consts::EXE_SUFFIX;
use std::path::{Path, PathBuf};
use std::process::Command;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

/// Name, smallest size, and how many pictures are side by side.
const EXAMPLES: [(&str, &str, u32); 8] = [
    ("custom_model", "4", 4),
    ("custom_strategy", "4", 3),
    ("fit_image", "4", 3),
    ("own_loop", "4", 3),
    ("own_op_gradcheck", "4", 2),
    ("refine_pose", "4", 5),
    ("render_channels", "4", 4),
    ("swap_loss", "4", 3),
];

/// Cargo builds examples before tests, into a folder beside that of the tests.
fn executable(name: &str) -> PathBuf {
    let test = std::env::current_exe().unwrap();
    let profile = test.parent().and_then(Path::parent).unwrap();
    let file = profile.join("examples").join(format!("{name}{EXE_SUFFIX}"));
    let remedy = "run `cargo test --release --workspace`, which builds examples too";
    assert!(file.is_file(), "{} is missing: {remedy}", file.display());
    file
}

#[test]
fn every_example_leaves_a_picture() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("examples");
    let _ = std::fs::remove_dir_all(&folder);
    for (name, size, parts) in EXAMPLES {
        let mut command = Command::new(executable(name));
        let run = command.current_dir(ROOT).arg(size).arg(&folder).output();
        let run = run.unwrap();
        let said = String::from_utf8_lossy(&run.stderr);
        assert!(run.status.success(), "{name}: {said}");
        let said = String::from_utf8_lossy(&run.stdout);
        assert!(
            said.lines().count() >= 2,
            "{name} printed no figures: {said}"
        );

        let file = folder.join(name).with_extension("png");
        let picture = image::open(&file).unwrap_or_else(|error| panic!("{name}: {error}"));
        let picture = picture.into_rgb8();
        let (width, height) = picture.dimensions();
        for part in 0..parts {
            // The middle of it, without the white between two.
            let columns = [2, 8].map(|tenth| (10 * part + tenth) * width / (10 * parts));
            let columns = columns[0]..columns[1];
            let pixels = columns.flat_map(|x| (0..height).map(move |y| (x, y)));
            let colors: HashSet<_> = pixels.map(|(x, y)| picture.get_pixel(x, y).0).collect();
            assert!(
                colors.len() > 1,
                "{name}: part {part} of its picture is constant"
            );
        }
    }
}

#[test]
fn every_example_is_short_tested_and_in_the_readme() {
    let readme = std::fs::read_to_string(Path::new(ROOT).join("README.md")).unwrap();
    let files = std::fs::read_dir(Path::new(ROOT).join("examples")).unwrap();
    let files = files.map(|file| file.unwrap().path());
    let mut found = Vec::new();
    for file in files.filter(|file| file.extension().is_some_and(|end| end == "rs")) {
        let name = file.file_stem().unwrap().to_string_lossy().into_owned();
        let text = std::fs::read_to_string(&file).unwrap();
        assert!(text.lines().count() < 80, "{name} has 80 lines or more");
        let command = format!("`cargo run --release --example {name} ");
        assert!(text.contains(&command), "{name} does not say {command}");
        assert!(
            readme.contains(&format!("(examples/{name}.rs)")),
            "README: {name}"
        );
        found.push(name);
    }
    found.sort();
    assert_eq!(found, EXAMPLES.map(|(name, ..)| name));
}
