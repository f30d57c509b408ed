//! Promises of the reader and the writer.

use std::path::{Path, PathBuf};

use tempfile::TempDir;

use super::super::test_scene::{difference, opacities, rotation_difference, scene};
use super::*;

/// Half a step of single precision on top of a bound.
const ROUNDING: f32 = 1e-5;

fn round_trip(scene: &SplatData, settings: &SpzSettings) -> SplatData {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("scene.spz");
    write_with(&path, scene, settings).unwrap();
    // No other file is left.
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    read(&path).unwrap()
}

fn written(scene: &SplatData) -> Vec<u8> {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("scene.spz");
    write(&path, scene).unwrap();
    std::fs::read(path).unwrap()
}

/// The message of reading a bad file, which must be one line and name the file.
fn message_of(bytes: &[u8]) -> String {
    let error = parse(Path::new("scene.spz"), bytes).expect_err("the file is bad");
    let message = error.to_string();
    assert!(message.starts_with("scene.spz: "), "`{message}`");
    assert!(!message.contains('\n'), "`{message}`");
    message
}

/// A Zstandard frame that holds bytes as they are (RFC 8878: single segment, one raw block).
fn stored_frame(bytes: &[u8]) -> Vec<u8> {
    let block = (bytes.len() as u32) << 3 | 1;
    let mut frame = vec![0x28, 0xb5, 0x2f, 0xfd, 0x20, bytes.len() as u8];
    frame.extend(&block.to_le_bytes()[..3]);
    frame.extend(bytes);
    frame
}

/// A gzip file that holds bytes as they are (RFC 1951 and 1952: one stored block).
fn stored_gzip(bytes: &[u8]) -> Vec<u8> {
    let mut checksum = !0u32;
    for &byte in bytes {
        checksum ^= u32::from(byte);
        for _ in 0..8 {
            checksum = (checksum >> 1) ^ ((checksum & 1) * 0xedb8_8320);
        }
    }
    let len = bytes.len() as u16;
    let mut file = vec![0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 255, 1];
    file.extend(len.to_le_bytes());
    file.extend((!len).to_le_bytes());
    file.extend(bytes);
    file.extend((!checksum).to_le_bytes());
    file.extend((bytes.len() as u32).to_le_bytes());
    file
}

/// A file of version 4 with streams of stored bytes.
fn version_4(head: &[u8; 4], count: u32, extensions: &[u8], arrays: &[&[u8]]) -> Vec<u8> {
    let mut file = b"NGSP\x04\0\0\0".to_vec();
    file.extend(count.to_le_bytes());
    file.extend(head);
    file.extend((32 + extensions.len() as u32).to_le_bytes());
    file.extend([0; 12]);
    file.extend(extensions);
    let frames: Vec<_> = arrays.iter().map(|array| stored_frame(array)).collect();
    for (frame, array) in frames.iter().zip(arrays) {
        file.extend((frame.len() as u64).to_le_bytes());
        file.extend((array.len() as u64).to_le_bytes());
    }
    file.extend(frames.concat());
    file
}

/// Arrays of one Gaussian of degree 1 with 10 fractional bits, by hand.
const POSITION: [u8; 9] = [0x00, 0x06, 0x00, 0x00, 0x09, 0x00, 0x00, 0xf4, 0xff];
const ALPHA: [u8; 1] = [51];
const COLOR: [u8; 3] = [0, 255, 51];
const SCALES: [u8; 3] = [0, 128, 255];
/// Largest w = 0.8; x = 0.36 is 260 steps, y = -0.48 is 347, z is 0.
const ROTATION: u32 = 3 << 30 | 260 << 20 | (512 + 347) << 10;
const SH: [u8; 9] = [192, 128, 64, 0, 255, 129, 160, 96, 128];

/// The Gaussian of those arrays.
fn assert_is_by_hand(scene: &SplatData) {
    // (1.5, 2.25, -3) with +y up and +z backward.
    assert_eq!(scene.means, [[1.5, -2.25, 3.0]]);
    assert_eq!(scene.log_scales, [[-10.0, -2.0, 5.9375]]);
    // 51 / 255 = 0.2.
    assert!(difference(&scene.opacity_logits, &[(0.2f32 / 0.8).ln()]) < 1e-6);
    let colors = [-0.5 / 0.15, 0.5 / 0.15, -0.3 / 0.15];
    assert!(difference(&scene.sh0[0], &colors) < 1e-6);
    assert_eq!(scene.sh_degree, 1);
    // The functions of degree 1 are y, z and x.
    let sh = [
        -0.5,
        0.0,
        0.5,
        1.0,
        -0.992_187_5,
        -0.007_812_5,
        0.25,
        -0.25,
        0.0,
    ];
    assert_eq!(scene.sh_rest, sh);
}

#[test]
fn version_4_is_read_as_the_layout_says() {
    let rotation = ROTATION.to_le_bytes();
    let arrays: [&[u8]; 6] = [&POSITION, &ALPHA, &COLOR, &SCALES, &rotation, &SH];
    let file = version_4(&[1, 10, 1, 6], 1, &[], &arrays);
    let scene = parse(Path::new("scene.spz"), &file).unwrap();
    assert_is_by_hand(&scene);
    // (w, x, -y, -z).
    assert!(difference(&scene.quats[0], &[0.8, 0.36, 0.48, 0.0]) < 1e-3);
    assert_eq!(scene.settings.antialias, Some(true));
    assert!(scene.settings.not_understood.is_empty());

    // Axes of our own: nothing is reversed.
    let mut extension = 0xADBE_0003u32.to_le_bytes().to_vec();
    extension.extend([4, 0, 0, 0, 6, 0, 0, 0]);
    let file = version_4(&[1, 10, 2, 6], 1, &extension, &arrays);
    let scene = parse(Path::new("scene.spz"), &file).unwrap();
    assert_eq!(scene.means, [[1.5, 2.25, -3.0]]);
    assert_eq!(scene.settings.antialias, Some(false));
    assert_eq!(scene.sh_rest[0], 0.5);
}

#[test]
fn version_4_is_written_as_the_layout_says() {
    let rotation = ROTATION.to_le_bytes();
    let arrays: [&[u8]; 6] = [&POSITION, &ALPHA, &COLOR, &SCALES, &rotation, &SH];
    let file = version_4(&[1, 10, 1, 6], 1, &[], &arrays);
    let scene = parse(Path::new("scene.spz"), &file).unwrap();
    let settings = SpzSettings::new().with_fractional_bits(10).with_sh1_bits(8);
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("scene.spz");
    write_with(&path, &scene, &settings).unwrap();
    let bytes = std::fs::read(path).unwrap();
    assert_eq!(bytes[..32], file[..32]);
    let mut at = 32 + 6 * 16;
    for (stream, array) in arrays.iter().enumerate() {
        let number = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
        let entry = 32 + 16 * stream;
        let compressed = number(entry) as usize;
        assert_eq!(number(entry + 8) as usize, array.len());
        let stream = zstd::bulk::decompress(&bytes[at..at + compressed], 100).unwrap();
        assert_eq!(stream, *array);
        at += compressed;
    }
    assert_eq!(at, bytes.len());
}

#[test]
fn versions_1_to_3_are_read_as_the_layout_says() {
    let rotation = ROTATION.to_le_bytes();
    // 0.36, -0.48 and 0 in steps of 1 / 127.5 from 127.5.
    let three = [173, 66, 128];
    // 1.5, 2.25 and -3 as half floats.
    let halves = [0x00, 0x3e, 0x80, 0x40, 0x00, 0xc2];
    for version in 1..=3u8 {
        let mut file = b"NGSP".to_vec();
        file.extend([version, 0, 0, 0, 1, 0, 0, 0, 1, 10, 1, 0]);
        file.extend(if version == 1 { &halves[..] } else { &POSITION });
        file.extend(ALPHA);
        file.extend(COLOR);
        file.extend(SCALES);
        file.extend(if version < 3 { &three[..] } else { &rotation });
        file.extend(SH);
        // Inside of gzip, or unpacked.
        for file in [stored_gzip(&file), file.clone()] {
            let scene = parse(Path::new("scene.spz"), &file).unwrap();
            assert_is_by_hand(&scene);
            assert!(difference(&scene.quats[0], &[0.8, 0.36, 0.48, 0.0]) < 0.01);
            assert_eq!(scene.settings.antialias, Some(true));
            for end in 0..file.len() {
                message_of(&file[..end]);
            }
        }
    }
}

#[test]
fn degree_4_is_left_out_with_a_warning() {
    let rotation = ROTATION.to_le_bytes();
    let mut sh = [128; 72];
    sh[44] = 192;
    sh[45..].fill(0);
    let arrays: [&[u8]; 6] = [&POSITION, &ALPHA, &COLOR, &SCALES, &rotation, &sh];
    let file = version_4(&[4, 10, 0, 6], 1, &[], &arrays);
    let scene = parse(Path::new("scene.spz"), &file).unwrap();
    assert_eq!((scene.sh_degree, scene.sh_rest.len()), (3, 45));
    assert_eq!(scene.sh_rest[43..], [0.0, 0.5]);
    let warnings = &scene.settings.not_understood;
    assert!(warnings[0].contains("degree 4"), "{warnings:?}");
}

#[test]
fn every_value_is_within_half_a_step() {
    for degree in 0..=3 {
        let scene = scene(300, degree);
        for (sh1_bits, sh_rest_bits) in [(5, 4), (8, 8), (1, 1)] {
            let settings = SpzSettings::new()
                .with_sh1_bits(sh1_bits)
                .with_sh_rest_bits(sh_rest_bits);
            let back = round_trip(&scene, &settings);
            // 30 leaves 23 - 5 bits.
            let step = 2f32.powi(-18);
            let flat = |values: &[[f32; 3]]| values.as_flattened().to_vec();
            let means = difference(&flat(&scene.means), &flat(&back.means));
            assert!(means <= step / 2.0 + 2e-6, "{means}");
            let scales = difference(&flat(&scene.log_scales), &flat(&back.log_scales));
            assert!(scales <= 1.0 / 32.0 + ROUNDING, "{scales}");
            let colors = difference(&flat(&scene.sh0), &flat(&back.sh0));
            assert!(colors <= 0.5 / 255.0 / 0.15 + ROUNDING, "{colors}");
            let alphas = difference(&opacities(&scene), &opacities(&back));
            assert!(alphas <= 0.5 / 255.0 + ROUNDING, "{alphas}");
            // The largest component takes the errors of the three others.
            let rotations = rotation_difference(&scene, &back);
            assert!(rotations <= 3.0 * 0.5 / 511.0 * 0.708, "{rotations}");
            let rest = scene.sh_rest_len();
            for (at, (a, b)) in scene.sh_rest.iter().zip(&back.sh_rest).enumerate() {
                let bits = if at % rest < 9 {
                    sh1_bits
                } else {
                    sh_rest_bits
                };
                // Half a bucket, and a step that 255 lacks at 1.
                let bound = f32::from(1u16 << (8 - bits)) / 256.0 + 1.0 / 128.0;
                assert!((a - b).abs() <= bound, "{at}: {a} {b}");
            }
            assert_eq!(back.settings.antialias, Some(false));
        }
    }
}

#[test]
fn what_is_never_drawn_and_what_is_infinite_stays_so() {
    let mut scene = scene(6, 0);
    scene.opacity_logits = vec![f32::INFINITY, f32::NEG_INFINITY, 3.0, 3.0, 3.0, 3.0];
    scene.quats[2] = [0.0; 4];
    scene.log_scales[3] = [f32::NEG_INFINITY, -2.0, -2.0];
    scene.log_scales[4] = [-2.0, 90.0, -2.0];
    scene.quats[5] = [1e-30, 0.0, 0.0, 1e-30];
    let back = round_trip(&scene, &SpzSettings::default());
    assert_eq!(back.opacity_logits[..2], scene.opacity_logits[..2]);
    assert_eq!(opacities(&back)[2], 0.0);
    assert_eq!(back.log_scales[3], [-10.0, -2.0, -2.0]);
    assert_eq!(opacities(&back)[4], 0.0);
    assert!(opacities(&back)[3] > 0.9);
    // Neither is a rotation too short for its square to be a number.
    scene.quats[2] = back.quats[2];
    assert!(rotation_difference(&scene, &back) < 2e-3);

    let path = Path::new("unwritten/scene.spz");
    scene.sh0[4][1] = f32::NAN;
    let message = write(path, &scene).unwrap_err().to_string();
    assert!(message.contains("Gaussian 4: f_dc_1 is NaN"), "{message}");
    scene.sh0[4][1] = 0.0;
    scene.log_scales[1][2] = f32::INFINITY;
    let message = write(path, &scene).unwrap_err().to_string();
    assert!(message.contains("Gaussian 1: scale_2 is inf"), "{message}");
    let empty = write(path, &SplatData::default()).unwrap_err().to_string();
    assert!(empty.contains("holds no Gaussian"), "{empty}");
    assert!(!PathBuf::from("unwritten").exists());
}

#[test]
fn positions_are_as_fine_as_the_farthest_allows() {
    let error = |farthest: f32| {
        let mut scene = scene(2, 0);
        scene.means = vec![[farthest, 0.0, 0.0], [farthest / 3.0, 0.0, 0.0]];
        let back = round_trip(&scene, &SpzSettings::default());
        assert!((back.means[0][0] - farthest).abs() <= farthest / (1 << 22) as f32);
        (back.means[1][0] - farthest / 3.0).abs() / farthest
    };
    for farthest in [0.02, 1.0, 100.0, 8e6] {
        assert!(error(farthest) < 2f32.powi(-22), "{farthest}");
    }
    let mut far = scene(2, 0);
    far.means[1][2] = -9e6;
    let message = write("scene.spz", &far).unwrap_err().to_string();
    assert!(message.contains("positions: Gaussian 1"), "{message}");
    far.means[1][2] = -9e3;
    let fine = SpzSettings::new().with_fractional_bits(12);
    let message = write_with("scene.spz", &far, &fine)
        .unwrap_err()
        .to_string();
    assert!(message.contains("9 fractional bits, not 12"), "{message}");
    let bad = SpzSettings::new().with_sh1_bits(9);
    let message = write_with("scene.spz", &far, &bad).unwrap_err().to_string();
    assert!(message.contains("sh1_bits is 9"), "{message}");
}

#[test]
fn an_origin_is_added_or_refused() {
    let mut scene = scene(9, 0);
    scene.settings.scene_scale = Some(5.0);
    scene.origin = [40.0, -20.0, 0.5];
    let back = round_trip(&scene, &SpzSettings::default());
    assert_eq!(back.origin, [0.0; 3]);
    for (mean, found) in scene.means.iter().zip(&back.means) {
        for axis in 0..3 {
            let expected = scene.origin[axis] as f32 + mean[axis];
            assert!((found[axis] - expected).abs() < 1e-5);
        }
    }
    assert!(losses::losses(&scene)[1].contains("added"));
    scene.origin[0] = 4e6;
    let message = write("scene.spz", &scene).unwrap_err().to_string();
    assert!(message.contains("origin is 4000000 -20 0.5"), "{message}");
}

#[test]
fn clamped_values_are_counted() {
    let mut scene = scene(9, 1);
    assert!(losses::losses(&scene).is_empty());
    scene.log_scales[2] = [-12.0, f32::NEG_INFINITY, 7.0];
    scene.sh0[1][0] = 3.5;
    scene.sh_rest[3] = -1.5;
    scene.settings.background = Some([0.0, 0.5, 1.0]);
    let losses = losses::losses(&scene);
    assert_eq!(losses.len(), 4, "{losses:?}");
    assert!(losses[0].contains("background 0 0.5 1"));
    assert!(losses[1].starts_with("2 scale(s)"));
    assert!(losses[2].starts_with("1 value(s) of sh0"));
    assert!(losses[3].starts_with("1 value(s) of sh_rest"));
}

#[test]
fn every_truncation_and_most_damage_is_an_error() {
    let good = written(&scene(3, 1));
    for end in 0..good.len() {
        message_of(&good[..end]);
    }
    for (at, byte, word) in [
        (0, b'X', "NGSP"),
        (4, 5, "version 5"),
        (4, 0, "version 0"),
        (12, 7, "SH degree 7"),
        (12, 2, "but 3 Gaussians have 72"),
        (13, 31, "31 fractional bits"),
        (15, 5, "5 streams instead of 6"),
        (16, 31, "inside of the header"),
        (19, 1, "truncated"),
        (40, 26, "positions: 26 bytes"),
        (32, 255, "positions"),
        (8, 0, "no Gaussian"),
    ] {
        let mut bad = good.clone();
        bad[at] = byte;
        let message = message_of(&bad);
        assert!(message.contains(word), "{at}: {message}");
    }
}

/// Neither a count nor a table makes the reader allocate what the file cannot hold.
#[test]
fn a_huge_count_is_refused_before_anything_is_allocated() {
    let mut bad = written(&scene(3, 1));
    bad[8..12].fill(0xff);
    let message = message_of(&bad);
    assert!(message.contains("4294967295 Gaussians in"), "{message}");

    let mut file = b"NGSP\x03\0\0\0\xff\xff\xff\x7f\x03\x0c\0\0".to_vec();
    file.extend([0; 9]);
    let message = message_of(&stored_gzip(&file));
    assert!(message.contains("2147483647 Gaussians in"), "{message}");
}
