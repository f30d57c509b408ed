//! Promises of the text readers: each line is classified correctly, whichever program or editor
//! wrote it.

use super::*;

const PATH: &str = "images.txt";
/// Names that are hard to tell from keypoints, and one in a subfolder.
const NAMES: [&str; 5] = [
    "0001.png",
    "cam 1/a b.png",
    "7 8 9.png",
    "1 2",
    "cam1/0001.png",
];
const KEYPOINTS: &str = "1.5 2.5 -1 3.0 4.0 12";
/// Keypoints that begin like an image: whole numbers, a small id in the ninth position, and more.
const LIKE_AN_IMAGE: &str = "10 20 -1 30 40 -1 50 60 7 70 80 12";

fn record(index: usize) -> String {
    let [id, name] = [&(index + 1).to_string(), NAMES[index]];
    format!("{id} 0.8 0 0.6 0 1.5 -2 0.25 7 {name}")
}

/// The file, with the lines that `after` adds after each image.
fn file(after: impl Fn(usize) -> &'static str) -> String {
    let lines = (0..NAMES.len()).map(|index| record(index) + "\n" + after(index));
    let head = "# Image list with two lines of data per image:\n# Number of images: 5, mean observations per image: 1.5\n";
    head.to_owned() + &lines.collect::<String>()
}

fn images(text: impl AsRef<[u8]>) -> Vec<ColmapImage> {
    parse_images(PATH.as_ref(), text.as_ref(), false)
        .unwrap()
        .records
}

fn error(text: impl AsRef<[u8]>) -> String {
    let error = parse_images(PATH.as_ref(), text.as_ref(), false).unwrap_err();
    let message = error.to_string();
    assert!(
        message.starts_with(PATH) && !message.contains('\n'),
        "{message}"
    );
    message
}

#[test]
fn images_are_found_whatever_follows_them() {
    let keypoints = |_| "1.5 2.5 -1 3.0 4.0 12\n";
    let mixed = |index: usize| {
        [
            "1.5 2.5 -1\n",
            "",
            "\n",
            "10 20 -1 30 40 -1 50 60 7 70 80 12\n",
            "\n\n",
        ][index]
    };
    let files = [
        ("keypoints", file(keypoints)),
        ("empty lines", file(|_| "\n")),
        ("no lines", file(|_| "")),
        ("all of these", file(mixed)),
        ("comments", file(|_| "# one\n1 2 3\n# two\n")),
        (
            "every line twice as far",
            file(keypoints).replace('\n', "\n\n"),
        ),
        ("no last line end", file(keypoints).trim_end().to_owned()),
    ];
    for (name, text) in files {
        let mark = "\u{feff}";
        for text in [
            text.clone(),
            text.replace('\n', "\r\n"),
            text.replace('\n', "\r"),
            mark.to_owned() + &text,
            mark.to_owned() + &text.replace('\n', "\r\n"),
        ] {
            let listed = parse_images(PATH.as_ref(), text.as_bytes(), false).unwrap();
            let names: Vec<&str> = listed.records.iter().map(|image| &*image.name).collect();
            assert_eq!(names, NAMES, "{name}: {text:?}");
            assert_eq!(listed.announced, Some(5));
            assert_eq!(listed.records[4].translation, [1.5, -2.0, 0.25]);
        }
    }
}

#[test]
fn what_could_be_either_is_what_its_place_says() {
    // Keypoints after an image; an image elsewhere.
    assert_eq!(images(record(0) + "\n" + LIKE_AN_IMAGE).len(), 1);
    let numbered = "3 1 0 0 0 5 5 5 7 10 11 12";
    for text in [
        format!("{numbered}\n{KEYPOINTS}\n"),
        format!("{}\n{KEYPOINTS}\n{numbered}\n\n", record(0)),
        format!("{}\n\n{numbered}\n\n", record(0)),
    ] {
        assert_eq!(images(&text).last().unwrap().name, "10 11 12", "{text}");
    }
    // Keypoints have no fractional id, so this is an image everywhere.
    let numbered = "3 1 0.5 0 0 5 5 5 7 10 11 12";
    assert_eq!(images(record(0) + "\n" + numbered).len(), 2);
}

#[test]
fn what_is_neither_is_named() {
    let first = record(0);
    for (text, words) in [
        (
            "1 1 0 0 0 0 0 x 7 a.png".to_owned(),
            ["line 1", "translation `x`"],
        ),
        (
            format!("{first}\n2 1 0 0 0 0 0 x 7 a b c.png"),
            ["line 2", "translation `x`"],
        ),
        (
            format!("{first}\n1.5 2.5 -1 3.5 4.5"),
            ["line 2", "image id `1.5`"],
        ),
        (
            format!("{first}\n{KEYPOINTS}\n{KEYPOINTS}"),
            ["line 3", "follow no image"],
        ),
        (
            format!("# hi\n\n{KEYPOINTS}"),
            ["line 3", "follow no image"],
        ),
        (
            "1 1 0 0 0 0 0 0 7 \n".to_owned(),
            ["line 1", "name is missing"],
        ),
    ] {
        let message = error(&text);
        for word in words {
            assert!(message.contains(word), "`{message}` does not say `{word}`");
        }
    }
    // The message shows part of the user's line and spells out invisible characters.
    let message = error(format!("\u{feff}\u{feff}{first}"));
    assert!(message.contains("u{feff}"), "{message}");
    assert!(error("x".repeat(100_000)).len() < 300);
}

#[test]
fn encodings_are_named() {
    let text = record(0);
    let utf16: Vec<u8> = text.encode_utf16().flat_map(u16::to_le_bytes).collect();
    assert!(error(&utf16).contains("UTF-16"));
    assert!(error([&[0xff, 0xfe], &utf16[..]].concat()).contains("UTF-16"));

    // Comments may be in any encoding; names may not, as they would match no file.
    let latin = [b"# caf\xe9\n", text.as_bytes()].concat();
    assert_eq!(images(&latin).len(), 1);
    let latin = b"# hi\n1 1 0 0 0 0 0 0 7 le caf\xe9.png\n";
    let message = error(latin);
    assert!(
        message.contains("line 2") && message.contains(r"`caf\xe9.png` is not UTF-8"),
        "{message}"
    );
    assert_eq!(
        images("1 1 0 0 0 0 0 0 7 le café.png")[0].name,
        "le café.png"
    );
}

#[test]
fn records_end_where_they_should() {
    let cameras = |text: &str| parse_cameras("cameras.txt".as_ref(), text.as_bytes());
    let points = |text: &str| parse_points("points3D.txt".as_ref(), text.as_bytes());
    let head = "# Camera list\n# Number of cameras: 3\n";
    let listed = cameras(&format!("\u{feff}{head}7 PINHOLE 32 24 40 41 15 12\r\n")).unwrap();
    assert_eq!((listed.records.len(), listed.announced), (1, Some(3)));

    let head = "# Number of points: 2, mean track length: 1\n";
    for track in ["", " 0.5", " 0.5 1 2", " 0.5 1 2 3 4"] {
        let listed = points(&format!("\u{feff}{head}9 0 1 2 3 4 5{track}\n")).unwrap();
        assert_eq!(
            (listed.records[0].point.color, listed.announced),
            ([3, 4, 5], Some(2))
        );
    }
    for track in [" x", " 0.5 1", " 0.5 1 2 3"] {
        let message = points(&format!("9 0 1 2 3 4 5{track}\n"))
            .unwrap_err()
            .to_string();
        assert!(message.contains("line 1"), "{message}");
    }
}

/// A camera with a parameter too few or too many has another model.
#[test]
fn the_number_of_parameters_is_that_of_the_model() {
    let cameras = |text: &str| parse_cameras("cameras.txt".as_ref(), text.as_bytes());
    for (line, words) in [
        (
            "7 PINHOLE 32 24 40 41 15",
            "has 4 parameters, but the line gives 3",
        ),
        (
            "7 PINHOLE 32 24 40 41 15 12 0.1",
            "has 4 parameters, but the line gives 5",
        ),
        ("7 PINHOLE 32 24", "has 4 parameters, but the line gives 0"),
        (
            "7 OPENCV 32 24 40 41 15 12 x",
            "has 8 parameters, but the line gives 5",
        ),
    ] {
        let message = cameras(line).unwrap_err().to_string();
        let model = line.split(' ').nth(1).unwrap();
        for word in ["cameras.txt: line 1", "camera 7", model, words] {
            assert!(message.contains(word), "`{message}` does not say `{word}`");
        }
    }
}

#[test]
fn counts_are_compared() {
    let path = Path::new("sparse/0/images.txt");
    let mut warnings = Vec::new();
    for (announced, read) in [(None, 2), (Some(2), 2), (Some(15), 8), (Some(0), 1)] {
        let listed = Listed {
            records: vec![(); read],
            announced,
        };
        assert_eq!(listed.checked(path, "images", &mut warnings).len(), read);
    }
    let messages: Vec<String> = warnings.iter().map(ToString::to_string).collect();
    assert_eq!(messages.len(), 2);
    for word in ["sparse/0/images.txt", "15 images", "lists 8"] {
        assert!(messages[0].contains(word), "{messages:?}");
    }
}
