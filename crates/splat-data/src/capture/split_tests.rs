//! Promises about the split into training and held-out views.

use std::path::Path;

use tempfile::TempDir;

use super::test_capture::{good, load};
use super::*;

fn error_of(root: &Path, file: &str) -> CaptureError {
    let error = load(root).expect_err("the capture is bad");
    let message = error.to_string();
    assert!(message.contains(file), "`{message}` does not name {file}");
    error
}

/// Indices of held-out and training views, and warnings.
type Found = (Vec<usize>, Vec<usize>, Vec<String>);

fn by_rule(root: &Path, rule: SplitRule) -> Result<Found, String> {
    let options = CaptureSettings::new().with_split(rule);
    let capture = Capture::load(root, &options).map_err(|error| error.to_string())?;
    let warnings = capture.warnings.iter().map(ToString::to_string).collect();
    Ok((capture.split.test, capture.split.train, warnings))
}

#[test]
fn every_eighth_view_is_held_out() {
    let (root, _) = good();
    let split = load(root.path()).unwrap().split;
    assert_eq!(split.test, [0, 8]);
    assert_eq!(split.train, [1, 2, 3, 4, 5, 6, 7]);
}

#[test]
fn a_named_split_is_followed() {
    let (root, _) = good();
    let path = root.path().join("split.json");
    let json = r#"{"rule": "mine", "train": ["view z.png", "view s.png"], "test": ["view y.png", "gone.png"]}"#;
    std::fs::write(&path, json).unwrap();
    let capture = load(root.path()).unwrap();
    let names = |indices: &[usize]| -> Vec<String> {
        let name = |&i: &usize| capture.views[i].name.clone();
        indices.iter().map(name).collect()
    };
    assert_eq!(names(&capture.split.train), ["view s.png", "view z.png"]);
    assert_eq!(names(&capture.split.test), ["view y.png"]);
    assert_eq!(
        capture.warnings,
        [
            CaptureWarning::SplitNamesUnknown {
                source: "split.json".into(),
                count: 1,
                first: "gone.png".into()
            },
            CaptureWarning::SplitLeavesOut {
                source: "split.json".into(),
                count: 6,
                first: "view r.png".into()
            },
        ]
    );

    std::fs::write(
        &path,
        r#"{"train": ["view z.png"], "test": ["view z.png"]}"#,
    )
    .unwrap();
    let message = error_of(root.path(), "split.json").to_string();
    for word in ["view z.png", "both in `train` and in `test`"] {
        assert!(message.contains(word), "{message}");
    }
    std::fs::write(&path, "[]").unwrap();
    error_of(root.path(), "split.json");

    // As saved by editors on Windows.
    let marked = format!("\u{feff}{}", json.replace(", ", ",\r\n"));
    std::fs::write(&path, marked).unwrap();
    assert_eq!(load(root.path()).unwrap().split, capture.split);
    let utf16: Vec<u8> = json.encode_utf16().flat_map(u16::to_le_bytes).collect();
    std::fs::write(&path, utf16).unwrap();
    assert!(
        error_of(root.path(), "split.json")
            .to_string()
            .contains("UTF-16")
    );
}

#[test]
fn another_interval_may_be_asked_for() {
    let (root, _) = good();
    let json = r#"{"train": [], "test": []}"#;
    std::fs::write(root.path().join("split.json"), json).unwrap();
    let every = |interval| by_rule(root.path(), SplitRule::Every(interval)).unwrap();
    assert_eq!(every(0), (vec![], (0..9).collect(), vec![]));
    assert_eq!(every(4), (vec![0, 4, 8], vec![1, 2, 3, 5, 6, 7], vec![]));
    assert!(every(1).1.is_empty());
    let options = CaptureSettings::new().with_split(SplitRule::Every(1));
    let capture = Capture::load(root.path(), &options).unwrap();
    let message = capture.check_trainable().unwrap_err().to_string();
    for word in [
        "none of the 9 photos",
        "--hold-out (1 holds out every photo)",
    ] {
        assert!(message.contains(word), "{message}");
    }
    assert_eq!(every(usize::MAX).0, [0]);
}

#[test]
fn held_out_views_may_be_named() {
    let (root, _) = good();
    let names = |names: &[&str]| {
        let names = names.iter().map(|name| (*name).to_owned()).collect();
        by_rule(root.path(), SplitRule::Names(names))
    };
    let (test, train, warnings) = names(&["view t.png", "view r.png"]).unwrap();
    assert_eq!((test, train), (vec![0, 2], vec![1, 3, 4, 5, 6, 7, 8]));
    assert_eq!(warnings, [""; 0]);
    let (test, _, warnings) = names(&["gone.png", "view r.png"]).unwrap();
    assert_eq!(test, [0]);
    assert!(warnings[0].contains("gone.png"), "{warnings:?}");
    assert!(
        names(&["view r.png", "view r.png"])
            .unwrap_err()
            .contains("twice")
    );
    let message = names(&["gone.png", "left.png"]).unwrap_err();
    for word in ["none of the 2", "`gone.png`", "`view r.png`"] {
        assert!(message.contains(word), "{message}");
    }
    assert!(names(&[]).unwrap().0.is_empty());
}

#[test]
fn a_file_may_name_the_split() {
    let (root, _) = good();
    let other = TempDir::new().unwrap();
    let file = |name: &str, text: &str| {
        let path = other.path().join(name);
        std::fs::write(&path, text).unwrap();
        by_rule(root.path(), SplitRule::File(path))
    };
    let all: Vec<usize> = (2..9).collect();
    let text = "\u{feff}# held out\r\nview r.png\r\n\r\n  view s.png \r\n";
    assert_eq!(file("names.txt", text).unwrap(), (vec![0, 1], all, vec![]));
    let json = r#"{"train": ["view z.png"], "test": ["view s.png"]}"#;
    for name in ["other.json", "other"] {
        let (test, train, warnings) = file(name, json).unwrap();
        assert_eq!((test, train), (vec![1], vec![8]));
        assert!(
            warnings[0].starts_with(&format!("{name} puts 7")),
            "{warnings:?}"
        );
    }
    assert!(
        file("other.json", "view r.png")
            .unwrap_err()
            .contains("not a split")
    );
    assert!(
        file("names.txt", "nothing.png")
            .unwrap_err()
            .contains("names.txt")
    );
    let missing = SplitRule::File(other.path().join("missing.txt"));
    assert!(
        by_rule(root.path(), missing)
            .unwrap_err()
            .contains("missing.txt")
    );
}
