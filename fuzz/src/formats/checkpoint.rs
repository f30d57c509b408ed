//! Checkpoints: safetensors with a model, its moments and the strategy's state, and JSON about the
//! run in the metadata.

use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use burn::tensor::Device;
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use serde_json::{Value, json};
use splat_trainer::Checkpoint;
use splat_trainer::expected_checksum;
use splat_trainer::{TrainSettings, Trainer};

use super::{
    Follow, Input, Target, capture, mutate_json, per_byte, safetensors as file, train_steps,
};
pub(super) const TARGET: Target = Target {
    name: "checkpoint",
    file: "checkpoint.safetensors",
    seeds,
    mutate,
    parse,
    follow_every: 16,
    memory: per_byte(32),
};

/// Key of the metadata.
const META: &str = "burn_splat";
/// Key of the checksum.
const CHECKSUM: &str = "burn_splat_checksum";

/// Few Gaussians, and density control at every step.
fn config(steps: usize) -> TrainSettings {
    let mut config = TrainSettings {
        steps,
        ..TrainSettings::default()
    };
    config.init.sh_degree = 1;
    config.density.every = 1;
    config.density.reset_every = 3;
    config.density.stop = 30_000;
    config.density.max_gaussians = Some(20);
    config
}

/// The state after each step of a short run.
fn seeds() -> Vec<Input> {
    let kept = Arc::new(Mutex::new(vec![]));
    let keep = kept.clone();
    let trainer = Trainer::builder(capture())
        .settings(config(8))
        .device(Device::flex())
        .autosave(Duration::ZERO, move |checkpoint| {
            keep.lock().expect("one thread").push(checkpoint.clone());
            Ok(())
        });
    trainer.build().and_then(Trainer::run).expect("a valid run");
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("checkpoint.safetensors");
    let kept = kept.lock().expect("one thread");
    let seed = |checkpoint: &Checkpoint| {
        checkpoint.save(&path).expect("a writable folder");
        Input(vec![std::fs::read(&path).expect("the file just written")])
    };
    kept.iter().step_by(3).map(seed).collect()
}

fn mutate(input: &mut Input, rng: &mut Pcg64Mcg) {
    let bytes = &mut input.0[0];
    let changed = rng.random_bool(0.25).then(|| meta(bytes, rng)).flatten();
    match changed {
        Some(changed) => *bytes = changed,
        None => file::mutate(bytes, rng),
    }
    // Mostly with a correct checksum, or nothing else would be tested.
    if rng.random_bool(0.95) {
        seal(bytes);
    }
}

fn seal(bytes: &mut Vec<u8>) {
    if let Some(checksum) = expected_checksum(bytes)
        && let Some((mut header, data)) = file::parts(bytes)
    {
        header["__metadata__"][CHECKSUM] = json!(checksum);
        *bytes = file::joined(&header, &data);
    }
}

/// Mutates the JSON about the run.
fn meta(bytes: &[u8], rng: &mut Pcg64Mcg) -> Option<Vec<u8>> {
    let (mut header, data) = file::parts(bytes)?;
    let text = header.get("__metadata__")?.get(META)?.as_str()?;
    let mut meta: Value = serde_json::from_str(text).ok()?;
    mutate_json(&mut meta, rng);
    header["__metadata__"][META] = json!(meta.to_string());
    Some(file::joined(&header, &data))
}

/// Reads a checkpoint; an accepted one is resumed for some steps.
fn parse(input: &Input) -> Result<Follow, String> {
    let checkpoint = Checkpoint::parse(Path::new("checkpoint.safetensors"), &input.0[0]);
    let checkpoint = checkpoint.map_err(|error| error.to_string())?;
    Ok(Box::new(move || {
        let config = config(checkpoint.step().saturating_add(4));
        train_steps(capture(), config, Some(checkpoint))
    }))
}
