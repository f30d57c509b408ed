//! Scene files: `convert` and `compact`.

use super::*;

/// Words behind `word` in a line of the output.
fn number_after(text: &str, word: &str) -> f64 {
    let (_, rest) = text.split_once(word).unwrap_or_else(|| panic!("{text}"));
    let number = rest.trim_start().split([' ', '\n']).next();
    number.unwrap().parse().unwrap_or_else(|_| panic!("{text}"))
}

fn psnr(capture: &Path, scene: &Path) -> f64 {
    let output = splat(&["eval", text(capture), text(scene), "--downscale", "4"]);
    succeed(&output);
    number_after(&String::from_utf8_lossy(&output.stdout), "mean")
}

#[test]
fn a_scene_is_converted_and_made_smaller() {
    let folder = TempDir::new().unwrap();
    let capture = example(folder.path());
    let out = folder.path().join("out");
    succeed(&train(&capture, &out, &["--steps", "200"]));
    let scene = out.join("scene.ply");
    let (whole, bytes) = (psnr(&capture, &scene), fs::metadata(&scene).unwrap().len());

    // Other programs' formats, and back.
    for ending in ["spz", "sog"] {
        let file = folder.path().join("scene").with_extension(ending);
        succeed(&splat(&["convert", text(&scene), text(&file)]));
        assert!(fs::metadata(&file).unwrap().len() * 4 < bytes, "{ending}");
        assert!((psnr(&capture, &file) - whole).abs() < 0.2, "{ending}");
        let back = folder.path().join("back.ply");
        succeed(&splat(&["convert", text(&file), text(&back)]));
        assert_eq!(psnr(&capture, &back), psnr(&capture, &file), "{ending}");
        succeed(&splat(&["info", text(&file)]));
    }

    for (ending, share) in [("spz", 0.15), ("sog", 0.15), ("ply", 0.9)] {
        let file = folder.path().join("small").with_extension(ending);
        let output = splat(&[
            "compact",
            text(&scene),
            "--capture",
            text(&capture),
            "--downscale",
            "4",
            "--max-loss",
            "0.3",
            "--out",
            text(&file),
        ]);
        succeed(&output);
        let size = fs::metadata(&file).unwrap().len();
        assert!(
            (size as f64) < share * bytes as f64,
            "{ending}: {size} of {bytes}"
        );
        // Held-out views lose no more than a little beyond what those that were judged may.
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        let (before, after) = (
            number_after(&said, "held-out views:"),
            number_after(&said, "before,"),
        );
        assert!((before - whole).abs() < 0.01, "{said}");
        assert!(after > before - 0.6, "{said}");
        assert!((psnr(&capture, &file) - after).abs() < 0.01, "{said}");
    }
}

/// The near plane of training is that of the capture's size, which SPZ has no room for.
#[test]
fn a_scene_that_does_not_say_its_size_has_that_of_the_capture() {
    let folder = TempDir::new().unwrap();
    let capture = example(folder.path());
    let out = folder.path().join("out");
    succeed(&train(&capture, &out, &["--steps", "1"]));
    let whole = fs::read(out.join("scene.ply")).unwrap();
    let comment = b"comment burn-splat scene_scale ";
    let begin = (whole.windows(comment.len())).position(|words| words == comment);
    let begin = begin.unwrap();
    let end = begin + whole[begin..].iter().position(|b| *b == b'\n').unwrap() + 1;
    let scores = [&b""[..], b"comment burn-splat scene_scale 100\n"].map(|line| {
        let file = folder.path().join("other.ply");
        fs::write(&file, [&whole[..begin], line, &whole[end..]].concat()).unwrap();
        psnr(&capture, &file)
    });
    let said = psnr(&capture, &out.join("scene.ply"));
    assert_eq!(scores[0], said);
    // It matters: nothing is farther away than this near plane.
    assert!(scores[1] < said - 1.0, "{scores:?} {said}");
}

#[test]
fn files_that_cannot_be_written_are_refused_before_the_work() {
    let folder = TempDir::new().unwrap();
    let capture = example(folder.path());
    let out = folder.path().join("out");
    succeed(&train(&capture, &out, &["--steps", "1"]));
    let scene = out.join("scene.ply");
    let refused = |arguments: &[&str]| {
        let output = splat(arguments);
        let line = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{line}");
        assert_eq!(line.trim_end().lines().count(), 1, "{line}");
        line
    };
    let line = refused(&["convert", text(&scene), "scene.splat"]);
    assert!(
        line.contains(".spz") && line.contains("scene.splat"),
        "{line}"
    );
    let line = refused(&["convert", text(&scene), text(&scene)]);
    assert!(line.contains("reads it"), "{line}");
    let compact = |more: &[&str]| {
        let given = ["compact", text(&scene), "--capture", text(&capture)];
        refused(&[&given, more].concat())
    };
    let line = compact(&["--out", text(&scene), "--downscale", "8"]);
    assert!(line.contains("reads it"), "{line}");
    let file = folder.path().join("x.spz");
    let output = splat(&[
        "compact",
        text(&scene),
        "--capture",
        text(&capture),
        "--out",
        text(&file),
        "--max-loss",
        "-1",
    ]);
    assert_eq!(output.status.code(), Some(2));
    assert!(!file.exists());
    // What no format can reach is no file.
    let output = splat(&[
        "compact",
        text(&scene),
        "--capture",
        text(&capture),
        "--downscale",
        "8",
        "--max-loss",
        "0",
        "--out",
        text(&file),
    ]);
    assert_eq!(output.status.success(), file.exists());
    if !output.status.success() {
        assert_eq!(output.status.code(), Some(1));
    }
}
