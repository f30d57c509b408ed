//! Promises of the check: nothing that a decoder invents passes, and no complete file is refused.
//!
//! The files show one synthetic picture, written by libjpeg-turbo.

use std::io::Cursor;

use image::{ImageFormat, ImageReader};

use super::*;

const SEQUENTIAL: &[u8] = include_bytes!("testdata/sequential.jpg");
const FILES: [(&str, &[u8]); 5] = [
    ("sequential, 4:2:2", SEQUENTIAL),
    ("restarts, 4:2:0", include_bytes!("testdata/restarts.jpg")),
    (
        "progressive, 4:2:0",
        include_bytes!("testdata/progressive.jpg"),
    ),
    (
        "progressive, gray, restarts",
        include_bytes!("testdata/progressive_gray.jpg"),
    ),
    ("four colours", include_bytes!("testdata/cmyk.jpg")),
];
const GOOD: Whole = Whole {
    ended: true,
    suspect: false,
};

/// The decoder's output for a file, with an end marker added if missing.
fn pixels(bytes: &[u8]) -> Option<Vec<u8>> {
    let bytes = [bytes, &END].concat();
    let reader = ImageReader::with_format(Cursor::new(bytes), ImageFormat::Jpeg);
    Some(reader.decode().ok()?.into_bytes())
}

/// Position after the header of the first scan.
fn first_data(bytes: &[u8]) -> usize {
    let mut bits = Bits::new(bytes, 2);
    loop {
        let marker = bits.marker().unwrap();
        bits.segment().unwrap();
        if marker == 0xda {
            return bits.at();
        }
    }
}

#[test]
fn whole_files_are_whole() {
    for (name, bytes) in FILES {
        assert_eq!(check(bytes), Ok(GOOD), "{name}");
        // Data after the picture is ignored.
        let and_more = [bytes, &[0xff, 0xd8, 0xff, 0xda, 0, 1, 2]].concat();
        assert_eq!(check(&and_more), Ok(GOOD), "{name}");
        // The whole picture without its end marker, and one byte more.
        let endless = Whole {
            ended: false,
            ..GOOD
        };
        let until = bytes.len() - END.len();
        for until in [until, until + 1] {
            assert_eq!(check(&bytes[..until]), Ok(endless), "{name}");
            assert_eq!(pixels(&bytes[..until]), pixels(bytes), "{name}");
        }
    }
}

#[test]
fn a_cut_file_is_refused_where_pixels_would_be_made_up() {
    let mut made_up = 0;
    for (name, bytes) in FILES {
        let whole = pixels(bytes).unwrap();
        for until in 0..bytes.len() {
            let cut = &bytes[..until];
            let ended = [cut, &END].concat();
            for cut in [cut, &ended] {
                let pixels = pixels(cut);
                made_up += usize::from(pixels.as_ref().is_some_and(|pixels| *pixels != whole));
                if check(cut).is_ok_and(|whole| !whole.suspect) {
                    assert_eq!(pixels.as_ref(), Some(&whole), "{name}, cut at {until}");
                }
            }
        }
    }
    assert!(made_up > 1000, "the decoder refuses {made_up} cuts itself");
}

#[test]
fn an_early_end_is_no_end() {
    for (name, bytes) in FILES {
        let data = first_data(bytes);
        for until in [data, data + 5, data + 10] {
            let error = check(&[&bytes[..until], &END].concat()).unwrap_err();
            assert!(error.contains("end after"), "{name}: {error}");
        }
    }
}

#[test]
fn lost_restarts_are_refused() {
    let bytes = FILES[1].1;
    let marker = |code| {
        bytes
            .windows(2)
            .position(|pair| pair == [0xff, code])
            .unwrap()
    };
    let [first, second] = [0xd0, 0xd1].map(marker);
    let without = [&bytes[..first], &bytes[second..]].concat();
    assert!(
        check(&without)
            .unwrap_err()
            .contains("end after 2 of 9 blocks")
    );
    assert!(pixels(&without).is_some());
}

/// Lost pieces of a file on disk read as zeros.
#[test]
fn a_hole_is_noticed() {
    let (mut holes, mut unnoticed) = (0, 0);
    for (_, bytes) in FILES {
        let whole = pixels(bytes);
        let data = first_data(bytes);
        for from in (data..bytes.len() - 70).step_by(5) {
            let mut holed = bytes.to_vec();
            holed[from..from + 64].fill(0);
            let unseen = check(&holed) == Ok(GOOD) && pixels(&holed) != whole;
            holes += 1;
            unnoticed += usize::from(unseen);
        }
    }
    // JPEG has no checksum, and zeros are data too, so the walk may come back into step. Measured:
    // 16 of 600.
    assert!(unnoticed * 20 <= holes, "{unnoticed} of {holes} holes");
}

#[test]
fn more_data_than_the_picture_takes_is_told() {
    // The header asks for only half of the height.
    let mut bytes = SEQUENTIAL.to_vec();
    let header = bytes
        .windows(2)
        .position(|pair| pair == [0xff, 0xc0])
        .unwrap();
    assert_eq!(bytes[header + 5..header + 7], [0, 37]);
    bytes[header + 6] = 16;
    let suspect = Whole {
        suspect: true,
        ..GOOD
    };
    assert_eq!(check(&bytes), Ok(suspect));
    // Without an end marker, that is a file cut off and padded.
    bytes.truncate(bytes.len() - 2);
    bytes.extend([0; 100]);
    assert!(check(&bytes).unwrap_err().contains("end is missing"));
}

#[test]
fn a_large_picture_of_no_data_takes_no_memory() {
    let mut bytes = FILES[2].1.to_vec();
    let header = bytes
        .windows(2)
        .position(|pair| pair == [0xff, 0xc2])
        .unwrap();
    bytes[header + 5..header + 9].fill(0xff);
    assert!(check(&bytes).unwrap_err().contains("too little"));
}

#[test]
fn noise_is_no_panic() {
    let mut state = 1u64;
    let mut random = move |below: usize| {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as usize % below
    };
    for (_, bytes) in FILES {
        for _ in 0..2000 {
            let mut spoilt = bytes.to_vec();
            for _ in 0..1 + random(4) {
                let at = random(spoilt.len());
                spoilt[at] = random(256) as u8;
            }
            let _ = check(&spoilt);
        }
    }
    for file in [
        &[][..],
        &[0xff],
        &[0xff, 0xd8],
        &[0xff, 0xd8, 0xff],
        b"\x89PNG",
    ] {
        check(file).unwrap_err();
    }
}
