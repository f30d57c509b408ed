//! COLMAP's binary model: three files of records after a count.

use std::ops::Range;
use std::sync::Arc;

use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use splat_data::capture::in_memory::parse as parse_capture;
use splat_trainer::TrainSettings;

use super::colmap::Model;
use super::{Follow, Input, Target, per_byte, train_steps};
use crate::mutate::{number, one_of, place, real};

pub(super) const TARGET: Target = Target {
    name: "colmap_binary",
    file: ".bin",
    seeds,
    mutate,
    parse: |input| parse(true, input),
    follow_every: 64,
    memory: per_byte(16),
};

fn seeds() -> Vec<Input> {
    vec![Model::small().binary()]
}

/// Parses a model; an accepted one is trained for a step.
pub(super) fn parse(binary: bool, input: &Input) -> Result<Follow, String> {
    let files = [0, 1, 2].map(|part| input.0[part].as_slice());
    let capture = parse_capture(binary, files).map_err(|error| error.to_string())?;
    Ok(Box::new(move || {
        let config = TrainSettings {
            steps: 4,
            ..TrainSettings::default()
        };
        train_steps(Arc::new(capture), config, None)
    }))
}

fn mutate(input: &mut Input, rng: &mut Pcg64Mcg) {
    let part = rng.random_range(0..3);
    let bytes = &mut input.0[part];
    let records = records(part, bytes);
    if bytes.len() < 8 || records.is_empty() {
        bytes.extend(number(rng).to_le_bytes());
        return;
    }
    let (a, b) = (one_of(rng, &records).clone(), one_of(rng, &records).clone());
    let count = u64::from_le_bytes(bytes[..8].try_into().expect("eight bytes"));
    let set_count = |bytes: &mut [u8], count: u64| bytes[..8].copy_from_slice(&count.to_le_bytes());
    match rng.random_range(0..8) {
        // Removes or repeats a record, with or without adjusting the count.
        0 => {
            bytes.drain(a);
            set_count(bytes, count.wrapping_sub(rng.random_range(0..=1)));
        }
        1 => {
            let copy = bytes[a].to_vec();
            bytes.splice(b.start..b.start, copy);
            set_count(bytes, count.wrapping_add(rng.random_range(0..=1)));
        }
        2 => {
            let new = number(rng);
            set_count(bytes, new);
        }
        3 => bytes.truncate(a.start + place(rng, a.len())),
        // An inner count, or whatever else ends a record.
        4 if a.len() >= 8 => {
            let at = a.end - 8;
            bytes[at..a.end].copy_from_slice(&number(rng).to_le_bytes());
        }
        5 => name(part, bytes, a, rng),
        _ => field(part, bytes, a, rng),
    }
}

/// Offsets of 8-byte numbers, and of 4-byte ones, in a record of each file.
const FIELDS: [(&[usize], &[usize]); 3] = [
    (&[8, 16, 24, 32, 40, 48], &[0, 4]),
    (&[4, 12, 20, 28, 36, 44, 52], &[0, 60]),
    (&[0, 8, 16, 24, 35, 43], &[]),
];

/// Changes a field of a record.
fn field(part: usize, bytes: &mut [u8], record: Range<usize>, rng: &mut Pcg64Mcg) {
    let (wide, narrow) = FIELDS[part];
    let (at, new) = if narrow.is_empty() || rng.random_bool(0.7) {
        let new = if rng.random_bool(0.7) {
            real(rng).to_le_bytes()
        } else {
            number(rng).to_le_bytes()
        };
        (*one_of(rng, wide), new.to_vec())
    } else {
        (
            *one_of(rng, narrow),
            (number(rng) as u32).to_le_bytes().to_vec(),
        )
    };
    let at = record.start + at;
    if at + new.len() <= record.end {
        bytes[at..at + new.len()].copy_from_slice(&new);
    }
}

/// Changes the name of an image.
fn name(part: usize, bytes: &mut Vec<u8>, record: Range<usize>, rng: &mut Pcg64Mcg) {
    let start = record.start + 64;
    if part != 1 || start >= record.end {
        return;
    }
    let end = bytes[start..record.end].iter().position(|byte| *byte == 0);
    let end = start + end.unwrap_or(0);
    let names: [&[u8]; 8] = [
        b"",
        b"../../etc/passwd",
        b"/etc/passwd",
        b"C:\\photo.png",
        b"view 0.png",
        b"\xff\xfe",
        b"a\nb",
        b"....",
    ];
    let new: Vec<u8> = match rng.random_range(0..3) {
        0 => vec![b'x'; 4_000],
        _ => one_of(rng, &names).to_vec(),
    };
    bytes.splice(start..end, new);
}

/// Ranges of a file's records, as far as they make sense.
fn records(part: usize, bytes: &[u8]) -> Vec<Range<usize>> {
    let count = |at: usize| -> Option<usize> {
        let bytes = bytes.get(at..at + 8)?;
        usize::try_from(u64::from_le_bytes(bytes.try_into().ok()?)).ok()
    };
    let end_of = |start: usize| -> Option<usize> {
        match part {
            0 => {
                let model = bytes.get(start + 4)?;
                let parameters = match *model {
                    1 | 2 | 8 | 15 => 4,
                    3 | 9 => 5,
                    4 | 5 => 8,
                    6 => 12,
                    _ => 3,
                };
                Some(start + 24 + 8 * parameters)
            }
            1 => {
                let name = bytes
                    .get(start + 64..)?
                    .iter()
                    .position(|byte| *byte == 0)?;
                let list = start + 64 + name + 1;
                list.checked_add(8 + count(list)?.checked_mul(24)?)
            }
            _ => (start + 51).checked_add(count(start + 43)?.checked_mul(8)?),
        }
    };
    let (mut records, mut start) = (vec![], 8);
    while let Some(end) = end_of(start).filter(|end| *end <= bytes.len()) {
        records.push(start..end);
        start = end;
    }
    records
}
