//! Scenes as SPZ: a header, and compressed arrays of a known length.

use std::path::Path;

use burn::tensor::Device;
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use splat_data::scene::spz::{self, SpzSettings};
use splat_model::Gaussians;

use super::{Follow, Input, Memory, Target, ply};
use crate::mutate;

pub(super) const TARGET: Target = Target {
    name: "spz",
    file: "scene.spz",
    seeds,
    mutate,
    parse,
    follow_every: 64,
    // A file may claim 65,536 Gaussians and two more for each byte; the arrays of one take 65 bytes
    // and the scene 236.
    memory: Memory {
        per_byte: 700,
        constant: 20 << 20,
    },
};

/// Bytes of the header of version 4.
const HEADER: usize = 32;
/// Bytes of an entry of the table.
const ENTRY: usize = 16;

fn seeds() -> Vec<Input> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let file = folder.path().join("scene.spz");
    let written = |count, degree, settings: &SpzSettings| {
        spz::write_with(&file, &ply::scene(count, degree), settings).expect("a valid scene");
        std::fs::read(&file).expect("the file just written")
    };
    let exact = SpzSettings::new().with_sh1_bits(8).with_sh_rest_bits(8);
    let seeds = [
        written(3, 0, &exact),
        written(2, 1, &SpzSettings::new()),
        written(1, 3, &exact),
        extended(&written(2, 0, &exact)),
        unpacked(1, 0),
        unpacked(2, 1),
        unpacked(3, 2),
    ];
    seeds.map(|seed| Input(vec![seed])).to_vec()
}

/// A file of an earlier version without gzip around it, which mutations would only break.
fn unpacked(version: u8, degree: u8) -> Vec<u8> {
    let mut file = b"NGSP".to_vec();
    file.extend([version, 0, 0, 0, 2, 0, 0, 0, degree, 12, 1, 0]);
    let position = if version == 1 { 6 } else { 9 };
    let rotation = if version < 3 { 3 } else { 4 };
    let sh = 3 * ((usize::from(degree) + 1).pow(2) - 1);
    let bytes = 2 * (position + 1 + 3 + 3 + rotation + sh);
    // Halves of these bytes are numbers.
    file.extend((0..bytes).map(|i| (i * 37 % 120) as u8));
    file
}

/// The same file with two extensions: axes and an unknown one.
fn extended(file: &[u8]) -> Vec<u8> {
    let mut records = 0xADBE_0003u32.to_le_bytes().to_vec();
    records.extend([4, 0, 0, 0, 6, 0, 0, 0]);
    records.extend([1, 0, 0x34, 0x12, 2, 0, 0, 0, 5, 6]);
    let mut out = file.to_vec();
    out[14] |= 2;
    out[16] = (HEADER + records.len()) as u8;
    out.splice(HEADER..HEADER, records);
    out
}

/// Mutates the header, the table or a stream, or puts a decompressed stream's mutation back.
fn mutate(input: &mut Input, rng: &mut Pcg64Mcg) {
    let file = &mut input.0[0];
    match rng.random_range(0..4) {
        0 => {
            let end = file.len().min(HEADER + 6 * ENTRY);
            let rest = file.split_off(end);
            mutate::bytes(file, rng);
            file.extend(rest);
        }
        1 => mutate::bytes(file, rng),
        2 if file.len() > 16 => {
            // Small counts agree with the arrays most often.
            file[8] = rng.random_range(0..5);
            file[12] = rng.random_range(0..6);
            file[4] = rng.random_range(0..6);
        }
        _ => mutate_value(file, rng),
    }
}

/// Overwrites a byte of the arrays, which are stored as they are in small streams.
fn mutate_value(file: &mut [u8], rng: &mut Pcg64Mcg) {
    if file.len() > HEADER {
        let at = rng.random_range(16..file.len());
        file[at] = *mutate::one_of(rng, &[0, 1, 127, 128, 129, 254, 255]);
    }
}

/// Reads a scene; an accepted one is rendered.
fn parse(input: &Input) -> Result<Follow, String> {
    let scene = spz::parse(Path::new("scene.spz"), &input.0[0]);
    let scene = scene.map_err(|error| error.to_string())?;
    Ok(Box::new(move || {
        if scene.len() > 100 {
            return false;
        }
        ply::renders(&Gaussians::from_data(&scene, &Device::flex()))
    }))
}
