//! `bench recipes`: a table that goes on where an earlier call ended.

use super::*;

/// `bench recipes` at a sixteenth of the size.
fn arguments<'a>(capture: &'a Path, out: &'a Path, more: &[&'a str]) -> Vec<&'a str> {
    let mut arguments = vec!["bench", "recipes", text(capture), "--out", text(out)];
    arguments.extend(["--downscale", "16", "--seeds", "1"]);
    arguments.extend(more);
    arguments
}

fn compare(capture: &Path, out: &Path, recipes: &str) -> String {
    let more = ["--steps", "20", "--recipes", recipes];
    let output = splat(&arguments(capture, out, &more));
    succeed(&output);
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Rows of the table, each its fields; none of them has a comma in this test.
fn rows(out: &Path) -> Vec<Vec<String>> {
    let table = fs::read_to_string(out.join("recipes.csv")).unwrap();
    let fields = |line: &str| line.split(',').map(str::to_owned).collect();
    table.lines().skip(1).map(fields).collect()
}

#[test]
fn recipes_are_compared_and_nothing_is_trained_twice() {
    let folder = TempDir::new().unwrap();
    let capture = example(folder.path());
    let out = folder.path().join("out");
    compare(&capture, &out, "default");
    let first = rows(&out);
    assert_eq!(first.len(), 1);
    assert_eq!(first[0][..2], ["capture", "default"]);

    // The second recipe joins the first, whose time shows that it is not made again.
    let said = compare(&capture, &out, "mcmc,default");
    let both = rows(&out);
    assert_eq!(both.len(), 2);
    assert_eq!(both[0], first[0]);
    assert_eq!(both[1][1], "mcmc");
    for row in &both {
        let number = |at: usize| -> f64 { row[at].parse().unwrap() };
        let [psnr, gaussians, seconds] = [7, 9, 11].map(number);
        assert!(psnr > 1.0 && gaussians > 100.0 && seconds > 0.0, "{row:?}");
        let [ply, spz] = [13, 14].map(number);
        assert!(ply > 200.0 * gaussians && spz < 0.5 * ply, "{row:?}");
    }
    for words in [
        "| capture | default | 20 | 1 |",
        "| capture | mcmc | 20 | 1 |",
        "| mcmc | 1 |",
        "Outside of training",
    ] {
        assert!(said.contains(words), "no `{words}` in: {said}");
    }

    // Photo and renders side by side, with gaps of four pixels.
    let width = |path: &str| image::image_dimensions(out.join(path)).unwrap().0;
    let one = width("views/capture/photo-16.png");
    assert_eq!(width("capture.png"), 3 * one + 2 * 4);
    let page = fs::read_to_string(out.join("recipes.md")).unwrap();
    assert!(page.contains(&said), "{page}");
    assert!(page.contains("the photo, mcmc, default."), "{page}");
    let svg = fs::read_to_string(out.join("recipes.svg")).unwrap();
    assert!(svg.contains("mcmc") && svg.contains("</svg>"));
    // The scenes that were weighed are gone.
    let left = fs::read_dir(&out).unwrap().count();
    assert_eq!(left, 5, "{:?}", fs::read_dir(&out));

    compare(&capture, &out, "default,mcmc");
    assert_eq!(rows(&out), both);

    // A recipe that was another one is measured anew.
    let table = fs::read_to_string(out.join("recipes.csv")).unwrap();
    let other = table.replacen(&both[0][2], "0123456789abcdef", 1);
    fs::write(out.join("recipes.csv"), other).unwrap();
    compare(&capture, &out, "default,mcmc");
    let anew = rows(&out);
    assert_eq!(anew[0], both[1]);
    assert_eq!(anew[1][..10], both[0][..10]);

    // What cannot be read is not replaced.
    let damaged = table.replacen(",20,16,", ",20,x,", 1);
    fs::write(out.join("recipes.csv"), &damaged).unwrap();
    let more = ["--steps", "20", "--recipes", "default"];
    let output = splat(&arguments(&capture, &out, &more));
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert!(
        errors.contains("recipes.csv: line 2: `downscale`"),
        "{errors}"
    );
    assert_eq!(
        fs::read_to_string(out.join("recipes.csv")).unwrap(),
        damaged
    );
}

#[test]
fn what_cannot_be_compared_is_refused_before_the_work() {
    let folder = TempDir::new().unwrap();
    let capture = example(folder.path());
    let out = folder.path().join("out");
    let missing = folder.path().join("nowhere");
    let bad: [(&[&str], &[&str]); 4] = [
        (&[text(&missing)], &["nowhere"]),
        (&[text(&capture)], &["both captures are called capture"]),
        (&["--steps", "0"], &["default", "`steps`"]),
        (&["--seed", "3"], &["--seeds"]),
    ];
    for (more, words) in bad {
        refused(&splat(&arguments(&capture, &out, more)), &out, words);
    }
}

#[test]
#[cfg(unix)]
fn an_interrupted_comparison_says_how_to_go_on() {
    use std::time::{Duration, Instant};

    let folder = TempDir::new().unwrap();
    let capture = example(folder.path());
    let out = folder.path().join("out");
    let more = ["--steps", "1000000", "--recipes", "default,mcmc"];
    let child = Command::new(env!("CARGO_BIN_EXE_splat"))
        .args(["--device", "cpu"])
        .args(arguments(&capture, &out, &more))
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    // Ctrl-C, once the program has begun to write.
    let start = Instant::now();
    while !out.exists() {
        assert!(start.elapsed() < Duration::from_secs(120), "no folder");
        std::thread::sleep(Duration::from_millis(5));
    }
    let kill = Command::new("kill")
        .args(["-INT", &child.id().to_string()])
        .status();
    assert!(kill.unwrap().success());
    let output = child.wait_with_output().unwrap();
    succeed(&output);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    let again = format!(
        "to go on: splat bench recipes --device cpu {}",
        text(&capture)
    );
    for words in [
        "stopped: 0 of 2 runs",
        &again,
        "--steps 1000000",
        text(&out),
    ] {
        assert!(said.contains(words), "no `{words}` in: {said}");
    }
}
