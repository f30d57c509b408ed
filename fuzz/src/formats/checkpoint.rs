//! Checkpoints: safetensors with a model, what is known of its run as JSON in the metadata, and the optimiser's record,
//! a file of Burn's within it.

use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use burn::tensor::Device;
use burn_pack::{Bytes, DType, Reader, Scalar, Tensor, Writer};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use serde_json::{Value, json};
use splat_trainer::train::Checkpoint;
use splat_trainer::train::expected_checksum;
use splat_trainer::{TrainConfig, Trainer};

use super::{
    Follow, Input, Target, capture, mutate_json, per_byte, safetensors as file, train_steps,
};
use crate::mutate::{self, number, one_of, place};

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
fn config(steps: usize) -> TrainConfig {
    let mut config = TrainConfig {
        steps,
        ..TrainConfig::default()
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
    let trainer = Trainer::builder()
        .capture(capture())
        .config(config(8))
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
    let changed = match rng.random_range(0..4) {
        0 => meta(bytes, rng),
        1 => optimizer(bytes, rng),
        _ => None,
    };
    match changed {
        Some(changed) => *bytes = changed,
        None => file::mutate(bytes, rng),
    }
    // Most with the checksum of what they are now, or nothing would be looked at but that.
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

/// Changes what is known of the run.
fn meta(bytes: &[u8], rng: &mut Pcg64Mcg) -> Option<Vec<u8>> {
    let (mut header, data) = file::parts(bytes)?;
    let text = header.get("__metadata__")?.get(META)?.as_str()?;
    let mut meta: Value = serde_json::from_str(text).ok()?;
    mutate_json(&mut meta, rng);
    header["__metadata__"][META] = json!(meta.to_string());
    Some(file::joined(&header, &data))
}

/// Changes the optimiser's record by its entries, and packs it again.
fn optimizer(bytes: &[u8], rng: &mut Pcg64Mcg) -> Option<Vec<u8>> {
    let (mut header, mut data) = file::parts(bytes)?;
    let offsets = header.get("optimizer")?.get("data_offsets")?.clone();
    let [start, end] = [0, 1].map(|at| offsets.get(at).and_then(Value::as_u64).map(|x| x as usize));
    let (start, end) = (start?, end?);
    // Only where it is last can it change its length.
    if start > end || end != data.len() {
        let record = data.get_mut(start..end)?;
        let mut changed = record.to_vec();
        mutate::bytes(&mut changed, rng);
        let count = changed.len().min(record.len());
        record[..count].copy_from_slice(&changed[..count]);
        return Some(file::joined(&header, &data));
    }
    let mut record = data.split_off(start);
    match repacked(&record, rng) {
        Some(new) if rng.random_bool(0.8) => record = new,
        _ => mutate::bytes(&mut record, rng),
    }
    data.extend(&record);
    header["optimizer"]["data_offsets"] = json!([start, data.len()]);
    header["optimizer"]["shape"] = json!([record.len()]);
    Some(file::joined(&header, &data))
}

fn repacked(record: &[u8], rng: &mut Pcg64Mcg) -> Option<Vec<u8>> {
    let reader = Reader::from_bytes(Bytes::from_bytes_vec(record.to_vec())).ok()?;
    let mut scalars: Vec<(String, Scalar)> = reader.scalars().clone().into_iter().collect();
    let mut paths: Vec<(String, String)> = reader.metadata().clone().into_iter().collect();
    let tensors: Result<Vec<_>, _> = reader
        .into_tensors()
        .ok()?
        .into_iter()
        .map(Tensor::into_parts)
        .collect();
    let mut tensors = tensors.ok()?;
    let (t, s, p) = (
        place(rng, tensors.len()),
        place(rng, scalars.len()),
        place(rng, paths.len()),
    );
    match rng.random_range(0..8) {
        0 if !tensors.is_empty() => {
            tensors.remove(t);
        }
        1 if !scalars.is_empty() => scalars[s].1 = Scalar::UInt(number(rng)),
        2 if !scalars.is_empty() => {
            scalars.remove(s);
        }
        3 if !paths.is_empty() => {
            let other = place(rng, paths.len());
            paths[p].1 = paths[other].1.clone();
        }
        4 if !paths.is_empty() => {
            paths.remove(p);
        }
        // Another shape of as many elements, or of fewer.
        5 if !tensors.is_empty() => {
            let count = tensors[t].4.len() / 4;
            tensors[t].2 = one_of(rng, &[vec![count], vec![1, count], vec![count, 1, 1]])
                .clone()
                .into();
        }
        6 if !tensors.is_empty() => {
            let count = tensors[t].4.len() / 8 * 4;
            tensors[t].4 = Bytes::from_bytes_vec(tensors[t].4[..count].to_vec());
            tensors[t].2 = vec![count / 4].into();
        }
        7 if !tensors.is_empty() => {
            tensors[t].1 = *one_of(rng, &[DType::I32, DType::U32, DType::F32])
        }
        _ if !tensors.is_empty() => {
            let mut values = tensors[t].4.to_vec();
            let at = place(rng, values.len() / 4) * 4;
            if let Some(value) = values.get_mut(at..at + 4) {
                value.copy_from_slice(&(mutate::real(rng) as f32).to_le_bytes());
            }
            tensors[t].4 = Bytes::from_bytes_vec(values);
        }
        _ => scalars.push(("7.__rank".into(), Scalar::UInt(number(rng)))),
    }
    let tensors = tensors
        .into_iter()
        .map(|(name, dtype, shape, id, bytes)| Tensor::new(name, dtype, shape, id, bytes))
        .collect();
    let writer = scalars
        .iter()
        .fold(Writer::new(tensors), |w, (key, value)| {
            w.with_scalar(key, *value)
        });
    let writer = paths
        .iter()
        .fold(writer, |w, (key, value)| w.with_metadata(key, value));
    Some(writer.into_bytes().ok()?.to_vec())
}

/// Reads a checkpoint; what is let through goes on for some steps.
fn parse(input: &Input) -> Result<Follow, String> {
    let checkpoint = Checkpoint::parse(Path::new("checkpoint.safetensors"), &input.0[0]);
    let checkpoint = checkpoint.map_err(|error| error.to_string())?;
    Ok(Box::new(move || {
        let config = config(checkpoint.step().saturating_add(4));
        train_steps(capture(), config, Some(checkpoint))
    }))
}
