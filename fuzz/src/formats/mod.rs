//! One file per format: valid seeds, format-aware mutations, and the code under test.

mod checkpoint;
mod colmap;
mod colmap_binary;
mod colmap_text;
mod config;
mod fixture;
mod gaussians;
mod ply;
mod points;
mod safetensors;
mod sog;
mod spz;
mod transforms;

use std::sync::{Arc, LazyLock};

use burn::tensor::Device;
use rand_pcg::Pcg64Mcg;
use splat_data::Capture;
use splat_trainer::Checkpoint;
use splat_trainer::{TrainSettings, Trainer};

/// An input: the contents of one file, or of several that belong together.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Input(pub Vec<Vec<u8>>);

/// The program's next stage for an accepted input; returns true if it succeeds.
pub type Follow = Box<dyn FnOnce() -> bool>;

/// A reader to fuzz.
pub struct Target {
    /// Its name.
    pub name: &'static str,
    /// Text that every message must contain: the file's name, or the common part of its files'
    /// names.
    pub file: &'static str,
    /// Small valid inputs.
    pub seeds: fn() -> Vec<Input>,
    /// Mutates an input with knowledge of its format.
    pub mutate: fn(&mut Input, &mut Pcg64Mcg),
    /// Runs the reader: returns the message of a refusal, or the next stage.
    pub parse: fn(&Input) -> Result<Follow, String>,
    /// One in this many accepted inputs is passed on.
    pub follow_every: u64,
    /// Memory that the reader may use.
    pub memory: Memory,
}

/// A bound on memory: bytes per input byte, and a constant.
#[derive(Debug, Clone, Copy)]
pub struct Memory {
    /// Factor of the input's length. The input itself, already in memory, does not count.
    pub per_byte: usize,
    /// Constant bytes.
    pub constant: usize,
}

/// All readers. The bounds of memory are stated only here. That of TOML is the library's: every
/// `{a=` begins a table.
///
/// | reader | bytes for each of the file | and |
/// |---|---|---|
/// | COLMAP, binary or text | 16 | 8 KiB |
/// | transforms.json | 128 | 8 KiB |
/// | PLY, of splats or points | 32 | 520 KiB, of which 512 are what the PLY library makes room for before it reads a list |
/// | SPZ | 700 | 20 MiB, as a file of any size may hold 65,536 Gaussians |
/// | SOG | 800 | 40 MiB, likewise, and its images |
/// | gradient fixture | 16 | 8 KiB |
/// | checkpoint | 32 | 8 KiB |
/// | Gaussians as burnpack | 32 | 2,056 KiB, of which 2,048 are what the library makes room for |
/// | settings (TOML), which are at most 1 MiB | 1,024 | 8 KiB |
pub static TARGETS: [Target; 11] = [
    colmap_binary::TARGET,
    colmap_text::TARGET,
    transforms::TARGET,
    ply::TARGET,
    spz::TARGET,
    sog::TARGET,
    points::TARGET,
    fixture::TARGET,
    checkpoint::TARGET,
    config::TARGET,
    gaussians::TARGET,
];

/// A bound of this many bytes per input byte, plus 8 KiB.
const fn per_byte(per_byte: usize) -> Memory {
    Memory {
        per_byte,
        constant: 8 << 10,
    }
}

/// A capture for training: that of the COLMAP seeds.
fn capture() -> Arc<Capture> {
    static CAPTURE: LazyLock<Arc<Capture>> = LazyLock::new(|| {
        let files = colmap::Model::small().binary();
        let [cameras, images, points] = [0, 1, 2].map(|part| files.0[part].as_slice());
        let capture = splat_data::capture::in_memory::parse(true, [cameras, images, points]);
        Arc::new(capture.expect("the seed is a valid model"))
    });
    CAPTURE.clone()
}

/// Takes some steps of a run; returns true if it could. A refusal is fine.
fn train_steps(
    capture: Arc<Capture>,
    config: TrainSettings,
    checkpoint: Option<Checkpoint>,
) -> bool {
    let mut trainer = Trainer::builder(capture)
        .settings(config)
        .device(Device::flex());
    if let Some(checkpoint) = checkpoint {
        trainer = trainer.resume(checkpoint);
    }
    let Ok(mut trainer) = trainer.build() else {
        return false;
    };
    // The third step may already add and remove Gaussians.
    let few = |trainer: &Trainer| trainer.model().len() < 1_000;
    (0..3).all(|_| !few(&trainer) || trainer.step().is_ok())
}

/// Replaces a random value in a JSON text by an odd one, or drops, repeats or renames an entry.
fn mutate_json(value: &mut serde_json::Value, rng: &mut Pcg64Mcg) {
    use rand::RngExt;
    use serde_json::{Value, json};

    use crate::mutate::{WORDS, number, one_of, place, real};
    let depth_first = rng.random_bool(0.8);
    match value {
        Value::Object(map) if depth_first && !map.is_empty() => {
            let at = place(rng, map.len());
            let name = map.keys().nth(at).cloned().unwrap_or_default();
            match rng.random_range(0..12) {
                0 => {
                    map.remove(&name);
                }
                1 => {
                    let other = map.keys().nth(place(rng, map.len())).cloned();
                    let entry = map[&name].clone();
                    map.insert(other.unwrap_or_default(), entry);
                }
                2 => {
                    let entry = map[&name].clone();
                    map.insert(format!("{name}{}", one_of(rng, &WORDS)), entry);
                }
                _ => mutate_json(&mut map[&name], rng),
            }
        }
        Value::Array(list) if depth_first && !list.is_empty() => {
            let at = place(rng, list.len());
            match rng.random_range(0..8) {
                0 => {
                    list.remove(at);
                }
                1 => list.insert(at, list[at].clone()),
                2 => {
                    let other = place(rng, list.len());
                    list.swap(at, other);
                }
                _ => mutate_json(&mut list[at], rng),
            }
        }
        other => {
            *other = match rng.random_range(0..6) {
                0 => json!(number(rng)),
                1 => json!(real(rng)),
                2 => json!(one_of(rng, &WORDS)),
                3 => json!(number(rng).to_string()),
                4 => one_of(rng, &[Value::Null, json!(true), json!({})]).clone(),
                _ => json!([number(rng)]),
            };
        }
    }
}
