//! Scenes as SOG: an archive of `meta.json` and images. Mutations change a file of it and correct
//! its checksum, or nothing behind the checksum would be tested.

use std::path::Path;

use burn::tensor::Device;
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use splat_data::scene::sog;
use splat_model::Gaussians;

use super::{Follow, Input, Memory, Target, mutate_json, ply};
use crate::mutate;

pub(super) const TARGET: Target = Target {
    name: "sog",
    file: "scene.sog",
    seeds,
    mutate,
    parse,
    follow_every: 64,
    // A file may claim 65,536 Gaussians and two more for each byte, and images twice as many pixels
    // as that.
    memory: Memory {
        per_byte: 800,
        constant: 40 << 20,
    },
};

fn seeds() -> Vec<Input> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let file = folder.path().join("scene.sog");
    let written = |count, degree| {
        let mut scene = ply::scene(count, degree);
        scene.origin = [1e6, -2.5, 3e5];
        scene.settings.antialias = Some(degree == 1);
        sog::write(&file, &scene).expect("a valid scene");
        std::fs::read(&file).expect("the file just written")
    };
    [(3, 0), (2, 1), (40, 2), (1, 3)]
        .map(|(count, degree)| Input(vec![written(count, degree)]))
        .to_vec()
}

/// Name and contents of the files of an archive whose entries are stored; empty if it is damaged.
fn entries(archive: &[u8]) -> Vec<(Vec<u8>, Vec<u8>)> {
    let mut entries = vec![];
    let mut rest = archive;
    while let Some(head) = rest.strip_prefix(b"PK\x03\x04") {
        let number = |at: usize, len: usize| {
            let bytes = head.get(at - 4..at - 4 + len)?;
            let digits = bytes.iter().rev();
            Some(digits.fold(0, |sum, byte| sum << 8 | usize::from(*byte)))
        };
        let (Some(len), Some(name), Some(extra)) = (number(18, 4), number(26, 2), number(28, 2))
        else {
            return vec![];
        };
        let body = 30 + name + extra;
        let (Some(title), Some(contents)) = (rest.get(30..30 + name), rest.get(body..body + len))
        else {
            return vec![];
        };
        entries.push((title.to_vec(), contents.to_vec()));
        rest = &rest[body + len..];
    }
    entries
}

/// A stored archive of files, with correct checksums.
fn archive(entries: &[(Vec<u8>, Vec<u8>)]) -> Vec<u8> {
    let (mut out, mut directory) = (vec![], vec![]);
    for (name, contents) in entries {
        let mut common = vec![0; 4];
        common.extend([0; 4]);
        common.extend(checksum(contents).to_le_bytes());
        common.extend((contents.len() as u32).to_le_bytes());
        common.extend((contents.len() as u32).to_le_bytes());
        common.extend((name.len() as u16).to_le_bytes());
        common.extend([0; 2]);
        directory.extend(b"PK\x01\x02\x0a\x00\x0a\x00");
        directory.extend(&common);
        directory.extend([0; 10]);
        directory.extend((out.len() as u32).to_le_bytes());
        directory.extend(name);
        out.extend(b"PK\x03\x04\x0a\x00");
        out.extend(&common);
        out.extend(name);
        out.extend(contents);
    }
    let start = out.len() as u32;
    let len = directory.len() as u32;
    out.extend(directory);
    out.extend(b"PK\x05\x06\0\0\0\0");
    out.extend([(entries.len() as u16).to_le_bytes(); 2].concat());
    out.extend(len.to_le_bytes());
    out.extend(start.to_le_bytes());
    out.extend([0; 2]);
    out
}

fn checksum(bytes: &[u8]) -> u32 {
    let mut sum = !0u32;
    for &byte in bytes {
        sum ^= u32::from(byte);
        for _ in 0..8 {
            sum = (sum >> 1) ^ ((sum & 1) * 0xedb8_8320);
        }
    }
    !sum
}

/// Mutates a file of the archive and its checksum, or the archive's bytes.
fn mutate(input: &mut Input, rng: &mut Pcg64Mcg) {
    let file = &mut input.0[0];
    let mut entries = entries(file);
    if entries.is_empty() || rng.random_bool(0.15) {
        mutate::bytes(file, rng);
        return;
    }
    let at = mutate::place(rng, entries.len());
    let other = mutate::place(rng, entries.len());
    match rng.random_range(0..8) {
        0 => {
            entries[at].1 = entries[other].1.clone();
        }
        1 => {
            entries.remove(at);
        }
        2 | 3 => mutate::bytes(&mut entries[at].1, rng),
        _ => {
            let meta = entries.iter_mut().find(|(name, _)| name == b"meta.json");
            let Some((_, text)) = meta else { return };
            match serde_json::from_slice(text) {
                Ok(mut value) => {
                    mutate_json(&mut value, rng);
                    *text = value.to_string().into_bytes();
                }
                Err(_) => mutate::bytes(text, rng),
            }
        }
    }
    *file = archive(&entries);
}

/// Reads a scene; an accepted one is rendered.
fn parse(input: &Input) -> Result<Follow, String> {
    let scene = sog::parse(Path::new("scene.sog"), &input.0[0]);
    let scene = scene.map_err(|error| error.to_string())?;
    Ok(Box::new(move || {
        if scene.len() > 100 {
            return false;
        }
        ply::renders(&Gaussians::from_data(&scene, &Device::flex()))
    }))
}
