//! Promises of the reader and the writer.

use std::path::PathBuf;

use tempfile::TempDir;

use super::super::SceneSettings;
use super::*;

/// A scene in which all values differ.
fn scene(count: usize, sh_degree: usize) -> SplatData {
    let mut next = 0.0f32;
    let mut value = || {
        next += 1.0;
        (next * 0.7).sin() * 10.0
    };
    let mut scene = SplatData {
        sh_degree,
        ..SplatData::default()
    };
    for _ in 0..count {
        scene.means.push(std::array::from_fn(|_| value()));
        scene.log_scales.push(std::array::from_fn(|_| value()));
        scene.quats.push(std::array::from_fn(|_| value()));
        scene.opacity_logits.push(value());
        scene.sh0.push(std::array::from_fn(|_| value()));
        let rest = scene.sh_rest_len();
        scene.sh_rest.extend((0..rest).map(|_| value()));
    }
    scene
}

fn file_in(folder: &TempDir) -> PathBuf {
    folder.path().join("scene.ply")
}

/// Writes `bytes` to a file and returns the error of reading it, which must be one line and name
/// the file.
fn error_of(bytes: &[u8]) -> SceneFileError {
    let folder = TempDir::new().unwrap();
    let path = file_in(&folder);
    std::fs::write(&path, bytes).unwrap();
    let error = read(&path).expect_err("the file is bad");
    let message = error.to_string();
    assert!(message.contains("scene.ply"), "`{message}`");
    assert!(!message.contains('\n'), "`{message}`");
    error
}

/// Header and values of `scene` as text, with the properties in reverse order and without normals.
fn ascii(scene: &SplatData, kind: &str) -> String {
    let names = property_names(scene.sh_rest_len());
    let keep = |i: &usize| !names[*i].starts_with('n');
    let order: Vec<usize> = (0..names.len()).rev().filter(keep).collect();
    let mut text = format!(
        "ply\nformat ascii 1.0\ncomment by hand\nelement vertex {}\n",
        scene.len()
    );
    for &i in &order {
        text += &format!("property {kind} {}\n", names[i]);
    }
    text += "property list uchar int extra\nend_header\n";
    let mut row = Row::new();
    for index in 0..scene.len() {
        row.fill(scene, index);
        for &i in &order {
            text += &format!("{} ", row.values[i]);
        }
        text += "2 5 6\n";
    }
    text
}

#[test]
fn round_trip_is_exact_in_every_degree() {
    let folder = TempDir::new().unwrap();
    for degree in 0..=3 {
        let mut scene = scene(7, degree);
        scene.means[3] = [-0.0, f32::MIN_POSITIVE / 8.0, f32::MAX];
        write(file_in(&folder), &scene).unwrap();
        let back = read(file_in(&folder)).unwrap();
        assert_eq!(back, scene);
        assert_eq!(
            back.means[3].map(f32::to_bits),
            scene.means[3].map(f32::to_bits)
        );
    }
    // No other file is left.
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn the_layout_is_that_of_3dgs() {
    let folder = TempDir::new().unwrap();
    let scene = scene(2, 1);
    write(file_in(&folder), &scene).unwrap();
    let bytes = std::fs::read(file_in(&folder)).unwrap();
    let header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n\
        property float x\nproperty float y\nproperty float z\n\
        property float nx\nproperty float ny\nproperty float nz\n\
        property float f_dc_0\nproperty float f_dc_1\nproperty float f_dc_2\n\
        property float f_rest_0\nproperty float f_rest_1\nproperty float f_rest_2\n\
        property float f_rest_3\nproperty float f_rest_4\nproperty float f_rest_5\n\
        property float f_rest_6\nproperty float f_rest_7\nproperty float f_rest_8\n\
        property float opacity\n\
        property float scale_0\nproperty float scale_1\nproperty float scale_2\n\
        property float rot_0\nproperty float rot_1\nproperty float rot_2\nproperty float rot_3\n\
        end_header\n";
    assert_eq!(&bytes[..header.len()], header.as_bytes());
    let values: Vec<f32> = bytes[header.len()..]
        .chunks_exact(4)
        .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
        .collect();
    assert_eq!(values.len(), 2 * 26);
    let second = &values[26..];
    assert_eq!(second[..3], scene.means[1]);
    assert_eq!(second[3..6], [0.0; 3]);
    assert_eq!(second[6..9], scene.sh0[1]);
    // Red of the three coefficients, then green, then blue.
    let rest = &scene.sh_rest[9..];
    let channel_major = [0, 3, 6, 1, 4, 7, 2, 5, 8].map(|i| rest[i]);
    assert_eq!(second[9..18], channel_major);
    assert_eq!(second[18], scene.opacity_logits[1]);
    assert_eq!(second[19..22], scene.log_scales[1]);
    assert_eq!(second[22..26], scene.quats[1]);
}

#[test]
fn ascii_in_any_order_is_read() {
    let folder = TempDir::new().unwrap();
    for degree in [0, 2] {
        let scene = scene(3, degree);
        for kind in ["float", "double"] {
            std::fs::write(file_in(&folder), ascii(&scene, kind)).unwrap();
            assert_eq!(read(file_in(&folder)).unwrap(), scene);
        }
    }
}

#[test]
fn big_endian_doubles_behind_another_element_are_read() {
    let scene = scene(2, 0);
    let names = property_names(0);
    let mut bytes = b"ply\nformat binary_big_endian 1.0\nelement camera 2\nproperty uchar id\n\
        property list uchar short path\nelement vertex 2\n"
        .to_vec();
    for name in &names {
        bytes.extend(format!("property double {name}\n").bytes());
    }
    bytes.extend(b"end_header\n");
    bytes.extend([9, 2, 0, 1, 0, 2]);
    bytes.extend([9, 0]);
    let mut row = Row::new();
    for index in 0..2 {
        row.fill(&scene, index);
        let doubles = row.values.iter().map(|&value| f64::from(value));
        bytes.extend(doubles.flat_map(f64::to_be_bytes));
    }
    let folder = TempDir::new().unwrap();
    std::fs::write(file_in(&folder), &bytes).unwrap();
    assert_eq!(read(file_in(&folder)).unwrap(), scene);
}

#[test]
fn every_truncation_is_an_error() {
    let folder = TempDir::new().unwrap();
    write(file_in(&folder), &scene(2, 0)).unwrap();
    let bytes = std::fs::read(file_in(&folder)).unwrap();
    for end in 0..bytes.len() {
        error_of(&bytes[..end]);
    }
    let last = error_of(&bytes[..bytes.len() - 1]);
    assert!(matches!(
        last,
        SceneFileError::Truncated {
            index: 1,
            count: 2,
            ..
        }
    ));

    let text = ascii(&scene(2, 0), "float");
    let last_line = text.trim_end().rfind('\n').unwrap();
    let last = error_of(&text.as_bytes()[..=last_line]);
    assert!(matches!(last, SceneFileError::Truncated { index: 1, .. }));
}

#[test]
fn a_damaged_count_is_no_huge_allocation() {
    let folder = TempDir::new().unwrap();
    write(file_in(&folder), &scene(1, 3)).unwrap();
    let bytes = std::fs::read(file_in(&folder)).unwrap();
    let text = b"element vertex 1\n";
    let at = bytes.windows(text.len()).position(|w| w == text).unwrap();
    let mut damaged = bytes[..at].to_vec();
    damaged.extend(format!("element vertex {}\n", u64::MAX).bytes());
    damaged.extend(&bytes[at + text.len()..]);
    let error = error_of(&damaged);
    assert!(matches!(error, SceneFileError::Truncated { index: 1, .. }));
}

#[test]
fn values_that_are_not_finite_are_named() {
    let folder = TempDir::new().unwrap();
    let good = scene(3, 1);
    let text = ascii(&good, "float");
    let value = good.sh_rest[9 + 3 * 2 + 1].to_string();
    for bad in ["nan", "inf", "1e60"] {
        let message = error_of(text.replacen(&value, bad, 1).as_bytes()).to_string();
        // Coefficient 2 of green is f_rest_5.
        assert!(message.contains("Gaussian 1: f_rest_5 is"), "{message}");
    }
    let message = error_of(text.replacen(&value, "x", 1).as_bytes()).to_string();
    assert!(message.contains("Gaussian 1: f_rest_5 `x`"), "{message}");

    let mut bad = good.clone();
    bad.log_scales[2][1] = f32::NAN;
    let path = file_in(&folder);
    let message = write(&path, &bad).unwrap_err().to_string();
    assert!(message.contains("Gaussian 2: scale_1 is NaN"), "{message}");
    // No partial file is left.
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

/// Opacities of 1 and 0, and flat Gaussians.
#[test]
fn infinities_that_mean_something_are_values() {
    let folder = TempDir::new().unwrap();
    let path = file_in(&folder);
    let mut infinite = scene(3, 1);
    infinite.opacity_logits = vec![f32::INFINITY, f32::NEG_INFINITY, 0.0];
    infinite.log_scales[1] = [f32::NEG_INFINITY, 0.5, f32::NEG_INFINITY];
    write(&path, &infinite).unwrap();
    assert_eq!(read(&path).unwrap(), infinite);
    std::fs::write(&path, ascii(&infinite, "float")).unwrap();
    assert_eq!(read(&path).unwrap(), infinite);

    type Spoil = fn(&mut SplatData);
    let spoilt: [(&str, Spoil); 5] = [
        ("scale_2 is inf", |s| s.log_scales[1][2] = f32::INFINITY),
        ("scale_0 is NaN", |s| s.log_scales[1][0] = f32::NAN),
        ("opacity is NaN", |s| s.opacity_logits[1] = f32::NAN),
        ("f_dc_0 is -inf", |s| s.sh0[1][0] = f32::NEG_INFINITY),
        ("rot_1 is inf", |s| s.quats[1][1] = f32::INFINITY),
    ];
    for (what, spoil) in spoilt {
        let mut bad = infinite.clone();
        spoil(&mut bad);
        let on_writing = write(&path, &bad).unwrap_err().to_string();
        let on_reading = error_of(ascii(&bad, "float").as_bytes()).to_string();
        for message in [on_writing, on_reading] {
            assert!(
                message.contains(&format!("Gaussian 1: {what}")),
                "{message}"
            );
        }
    }
}

#[test]
fn headers_that_do_not_fit_are_named() {
    let text = ascii(&scene(2, 1), "float");
    let without = |property: &str| text.replace(&format!("property float {property}\n"), "");
    let message = |text: &str| error_of(text.as_bytes()).to_string();

    for property in ["x", "f_dc_2", "opacity", "scale_1", "rot_3"] {
        let message = message(&without(property));
        assert!(message.contains(&format!("`{property}`")), "{message}");
    }
    assert!(message(&without("f_rest_8")).contains("8 properties f_rest_*"));
    assert!(message(&text.replace("f_rest_8\n", "f_rest_9\n")).contains("`f_rest_8`"));
    assert!(message(&text.replace("float rot_0", "list uchar float rot_0")).contains("`rot_0`"));
    assert!(message(&text.replace("vertex 2", "vertex 0")).contains("no Gaussian"));
    assert!(message(&text.replace("element vertex", "element point")).contains("`vertex`"));
    assert!(message(&text.replace("float opacity", "uint packed_position")).contains("compressed"));
    assert!(message("solid cube\n").contains("no PLY header"));
    assert!(message("").contains("no PLY header"));
    // A repeated name would shift all later values.
    message(&text.replace("float f_dc_0", "float f_dc_1"));
}

#[test]
fn arrays_that_do_not_fit_are_named() {
    let folder = TempDir::new().unwrap();
    let mut bad = scene(3, 1);
    bad.sh_rest.pop();
    let message = write(file_in(&folder), &bad).unwrap_err().to_string();
    assert!(
        message.contains("sh_rest has 26 entries instead of 27"),
        "{message}"
    );
    bad.sh_degree = 4;
    assert!(write(file_in(&folder), &bad).is_err());
}

/// A text file of one Gaussian with these lines inserted after the first; the values come last.
fn with_lines(lines: &str) -> Vec<u8> {
    let text = ascii(&scene(1, 0), "float");
    text.replacen("format ascii 1.0\ncomment by hand\n", lines, 1)
        .into_bytes()
}

fn read_bytes(bytes: &[u8]) -> Result<SplatData, SceneFileError> {
    parse(Path::new("scene.ply"), bytes)
}

#[test]
fn origin_and_settings_survive() {
    let folder = TempDir::new().unwrap();
    let path = file_in(&folder);
    let mut scene = scene(3, 0);
    scene.origin = [4.5e6, -0.1, 1e-300];
    scene.settings = SceneSettings {
        scene_scale: Some(2.0 / 3.0),
        antialias: Some(true),
        background: Some([0.0, 0.1, 1.0]),
        not_understood: Vec::new(),
    };
    write(&path, &scene).unwrap();
    assert_eq!(read(&path).unwrap(), scene);
    let bytes = std::fs::read(&path).unwrap();
    let header = String::from_utf8_lossy(&bytes);
    // Comments for other programs.
    for line in [
        "comment SplatRenderMode: mip\n",
        "comment antialiased 1\n",
        "comment burn-splat origin 4500000 -0.1 0.",
        "comment burn-splat scene_scale 6.666666666666666e-1\n",
        "comment burn-splat antialias 1\n",
        "comment burn-splat background 0 0.1 1\n",
    ] {
        assert!(header.contains(line), "no `{line}`");
    }

    // A comment that begins with our word must be a valid origin.
    let at = bytes.windows(7).position(|w| w == b"4500000").unwrap();
    let spoilt = [&bytes[..at], b"4500x00", &bytes[at + 7..]].concat();
    let message = error_of(&spoilt).to_string();
    assert!(
        message.contains("4500x00") && message.contains("three finite"),
        "{message}"
    );

    for (spoil, named) in [
        (
            (|s| s.scene_scale = Some(0.0)) as fn(&mut SceneSettings),
            "scene_scale is 0.0",
        ),
        (
            |s| s.background = Some([0.0, f32::NAN, 0.0]),
            "background is [0.0, NaN, 0.0]",
        ),
    ] {
        let mut bad = scene.clone();
        spoil(&mut bad.settings);
        let message = write(&path, &bad).unwrap_err().to_string();
        assert!(message.contains(named), "{message}");
    }
    assert_eq!(read(&path).unwrap(), scene);
}

#[test]
fn prose_in_comments_is_passed_over() {
    let format = "format ascii 1.0\n";
    for prose in [
        "origin is scene centre",
        "origin of this file: a scan",
        "origin",
        "origin 1 2 3 4",
        "antialiased yes",
        "antialiased",
        "background 1 1 1",
        "burn-splat",
        "burn-splats antialias 1",
        "",
    ] {
        let read = read_bytes(&with_lines(&format!("{format}comment {prose}\n")));
        assert_eq!(read.unwrap(), scene(1, 0), "`{prose}`");
    }
    // The form of earlier versions is still accepted.
    let old = read_bytes(&with_lines(&format!("{format}comment origin 1 -2e3 0.5\n"))).unwrap();
    assert_eq!(old.origin, [1.0, -2000.0, 0.5]);
}

#[test]
fn comments_that_almost_say_something_are_told_or_refused() {
    let read = |comment: &str| read_bytes(&with_lines(&format!("format ascii 1.0\n{comment}\n")));
    for told in [
        "origin 1 2 3x",
        "SplatRenderMode: 2dgs",
        "burn-splat gamma 2.2",
        "burn-splat is a program",
    ] {
        let settings = read(&format!("comment {told}")).unwrap().settings;
        assert_eq!(settings.not_understood, [told]);
    }
    for refused in [
        "burn-splat origin 1 2",
        "burn-splat origin 1 2 inf",
        "burn-splat scene_scale -1",
        "burn-splat scene_scale NaN",
        "burn-splat antialias 2",
        "burn-splat antialias",
        "burn-splat background 1 1",
        "burn-splat background 1 1 nan",
    ] {
        let message = read(&format!("comment {refused}")).unwrap_err().to_string();
        assert!(message.contains(refused), "{message}");
    }
    // Two comments: ours must agree; of others the first wins; ours take precedence.
    let both = |a: &str, b: &str| read(&format!("comment {a}\ncomment {b}"));
    let message = both("burn-splat antialias 1", "burn-splat antialias 0").unwrap_err();
    assert!(message.to_string().contains("something else"), "{message}");
    let settings = both("SplatRenderMode: mip", "antialiased 0")
        .unwrap()
        .settings;
    assert_eq!(settings.antialias, Some(true));
    assert_eq!(settings.not_understood, ["antialiased 0"]);
    let settings = both("antialiased 0", "burn-splat antialias 1")
        .unwrap()
        .settings;
    assert_eq!(
        (settings.antialias, settings.not_understood.len()),
        (Some(true), 0)
    );
    let scene = both("origin 1 2 3", "burn-splat origin 4 5 6").unwrap();
    assert_eq!(scene.origin, [4.0, 5.0, 6.0]);
}

#[test]
fn odd_headers_are_read() {
    let plain = ascii(&scene(2, 0), "float");
    let odd: [(&str, Vec<u8>); 8] = [
        (
            "byte-order mark",
            [b"\xEF\xBB\xBF", plain.as_bytes()].concat(),
        ),
        ("CRLF", plain.replace('\n', "\r\n").into_bytes()),
        (
            "comments before the format",
            plain
                .replacen("format", "comment first\nobj_info second 2\nformat", 1)
                .into_bytes(),
        ),
        (
            "blank lines",
            plain.replacen("format", "\n \t\nformat", 1).into_bytes(),
        ),
        (
            "indentation",
            plain.replace("property", "  property").into_bytes(),
        ),
        (
            "spaces at the ends",
            plain
                .replace("float", "float ")
                .replace("1.0\n", "1.0 \n")
                .into_bytes(),
        ),
        (
            "Latin-1",
            [
                b"ply\ncomment cr\xe9\xe9 par un autre\n",
                &plain.as_bytes()[4..],
            ]
            .concat(),
        ),
        (
            "empty comments",
            plain
                .replacen("comment by hand", "comment\nobj_info\ncomment a\rb", 1)
                .into_bytes(),
        ),
    ];
    for (name, bytes) in odd {
        let read = read_bytes(&bytes);
        assert_eq!(
            read.unwrap_or_else(|error| panic!("{name}: {error}")),
            scene(2, 0),
            "{name}"
        );
    }
    // After a header with carriage returns, the values follow exactly.
    let folder = TempDir::new().unwrap();
    write(file_in(&folder), &scene(2, 1)).unwrap();
    let bytes = std::fs::read(file_in(&folder)).unwrap();
    let end = b"end_header\n";
    let at = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let header = String::from_utf8_lossy(&bytes[..at]).replace('\n', "\r\n");
    let read = read_bytes(&[header.as_bytes(), &bytes[at..]].concat());
    assert_eq!(read.unwrap(), scene(2, 1));

    let old_mac = plain.replace('\n', "\r");
    let message = error_of(old_mac.as_bytes()).to_string();
    assert!(message.contains("carriage returns"), "{message}");
    let message = error_of(plain.replacen("element", "elephant", 1).as_bytes()).to_string();
    assert!(
        message.contains("Line 4") && message.contains("elephant"),
        "{message}"
    );
}

/// An endless header or an empty element takes neither time nor memory.
#[test]
fn headers_that_announce_too_much_end_soon() {
    let endless = [b"ply\ncomment ".to_vec(), vec![b'x'; 3 << 20]].concat();
    let message = error_of(&endless).to_string();
    assert!(
        message.contains("end_header") && message.len() < 200,
        "{message}"
    );

    let folder = TempDir::new().unwrap();
    write(file_in(&folder), &scene(1, 0)).unwrap();
    let bytes = std::fs::read(file_in(&folder)).unwrap();
    let text = b"element vertex 1\n";
    let at = bytes.windows(text.len()).position(|w| w == text).unwrap();
    let nothing = format!("element nothing {}\n", u64::MAX);
    let padded = [&bytes[..at], nothing.as_bytes(), &bytes[at..]].concat();
    assert_eq!(read_bytes(&padded).unwrap(), scene(1, 0));
}

/// Of two properties with one name the library keeps one, and reads all later values from the wrong
/// position.
#[test]
fn a_name_that_occurs_twice_is_refused_whatever_it_names() {
    let text = ascii(&scene(2, 0), "float");
    for (line, again) in [
        (
            "property float x\n",
            "property uchar spare\nproperty uchar spare\n",
        ),
        (
            "element vertex 2\n",
            "element spare 0\nelement spare 0\nproperty int i\n",
        ),
    ] {
        let message =
            error_of(text.replace(line, &format!("{again}{line}")).as_bytes()).to_string();
        assert!(message.contains("spare"), "{message}");
        assert!(message.contains("repeats a name"), "{message}");
    }
    // In different elements it is not a repetition.
    let two = "element camera 0\nproperty float x\nelement vertex 2\n";
    let two = text.replace("element vertex 2\n", two);
    assert_eq!(
        parse(Path::new("scene.ply"), two.as_bytes()).unwrap(),
        scene(2, 0)
    );
}

/// Such an element takes no bytes in the file; counting through it took time proportional to its
/// count.
#[test]
fn an_element_without_properties_takes_no_time() {
    let folder = TempDir::new().unwrap();
    write(file_in(&folder), &scene(2, 1)).unwrap();
    let bytes = std::fs::read(file_in(&folder)).unwrap();
    let at = bytes.windows(7).position(|w| w == b"element").unwrap();
    let (before, after) = bytes.split_at(at);
    let nothing = format!("element nothing {}\n", u64::MAX);
    let bytes = [before, nothing.as_bytes(), after].concat();
    assert_eq!(parse(Path::new("scene.ply"), &bytes).unwrap(), scene(2, 1));
}

#[test]
fn a_line_with_more_values_than_the_header_knows_is_refused() {
    let text = ascii(&scene(2, 0), "float");
    let message = error_of(text.replacen("2 5 6\n", "2 5 6 7\n", 1).as_bytes()).to_string();
    assert!(
        message.contains("Gaussian 0: extra is followed by `7`"),
        "{message}"
    );
}

/// A file without an end of header is of another kind, and is not read to its end.
#[test]
fn a_header_without_end_is_given_up() {
    let text = format!(
        "ply\nformat ascii 1.0\n{}",
        "comment and so on\n".repeat(100_000)
    );
    let message = error_of(text.as_bytes()).to_string();
    assert!(message.contains("1048576 bytes"), "{message}");
}
