//! Safetensors files, including fixtures and checkpoints: a length, a JSON header, and data.

use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use serde_json::{Value, json};

use super::mutate_json;
use crate::mutate::{self, WORDS, number, one_of, place};

/// Writes tensors of f32 or f64 with metadata.
pub(super) fn written(
    tensors: &[(String, safetensors::Dtype, Vec<usize>, Vec<u8>)],
    metadata: &[(&str, &str)],
) -> Vec<u8> {
    let views = tensors.iter().map(|(name, dtype, shape, data)| {
        let view = safetensors::tensor::TensorView::new(*dtype, shape.clone(), data);
        (name.as_str(), view.expect("the data fits the shape"))
    });
    let owned = |(key, value): &(&str, &str)| (key.to_string(), value.to_string());
    let metadata = metadata.iter().map(owned).collect();
    safetensors::serialize(views, Some(metadata)).expect("a valid file")
}

/// Header and data, if they can be told apart.
pub(super) fn parts(file: &[u8]) -> Option<(Value, Vec<u8>)> {
    let (length, rest) = file.split_first_chunk::<8>()?;
    let length = usize::try_from(u64::from_le_bytes(*length)).ok()?;
    let header = serde_json::from_slice(rest.get(..length)?).ok()?;
    Some((header, rest[length..].to_vec()))
}

/// Joins a header and data.
pub(super) fn joined(header: &Value, data: &[u8]) -> Vec<u8> {
    let header = header.to_string();
    let length = (header.len() as u64).to_le_bytes();
    [&length[..], header.as_bytes(), data].concat()
}

/// Mutates a file's tensors, metadata or data.
pub(super) fn mutate(file: &mut Vec<u8>, rng: &mut Pcg64Mcg) {
    let Some((mut header, mut data)) = parts(file) else {
        mutate::bytes(file, rng);
        return;
    };
    match rng.random_range(0..8) {
        0 | 1 => mutate::bytes(&mut data, rng),
        2 => {
            let length = number(rng).to_le_bytes();
            let count = length.len().min(file.len());
            file[..count].copy_from_slice(&length[..count]);
            return;
        }
        3 => mutate_json(&mut header, rng),
        4 => drop_tensor(&mut header, &mut data, rng),
        _ => tensor(&mut header, rng),
    }
    *file = joined(&header, &data);
}

/// Removes a tensor with its data, so that the file is valid except for the missing tensor.
fn drop_tensor(header: &mut Value, data: &mut Vec<u8>, rng: &mut Pcg64Mcg) {
    let Some(map) = header.as_object_mut().filter(|map| !map.is_empty()) else {
        return;
    };
    let name = map
        .keys()
        .nth(place(rng, map.len()))
        .cloned()
        .unwrap_or_default();
    let offset = |entry: &Value, at: usize| entry["data_offsets"][at].as_u64().map(|x| x as usize);
    let Some(entry) = map.remove(&name) else {
        return;
    };
    let (Some(start), Some(end)) = (offset(&entry, 0), offset(&entry, 1)) else {
        return;
    };
    if start > end || end > data.len() {
        return;
    }
    data.drain(start..end);
    for entry in map.values_mut() {
        if let (Some(from), Some(to)) = (offset(entry, 0), offset(entry, 1))
            && from >= end
            && to >= end
        {
            entry["data_offsets"] = json!([from - (end - start), to - (end - start)]);
        }
    }
}

/// Changes a tensor's shape or type, with or without regard to its size, or its name or position.
fn tensor(header: &mut Value, rng: &mut Pcg64Mcg) {
    let Some(map) = header.as_object_mut() else {
        return;
    };
    let tensors: Vec<String> = map
        .keys()
        .filter(|name| *name != "__metadata__")
        .cloned()
        .collect();
    if tensors.is_empty() {
        return;
    }
    let name = one_of(rng, &tensors).clone();
    let Some(entry) = map.get_mut(&name).filter(|entry| entry.is_object()) else {
        return;
    };
    match rng.random_range(0..7) {
        0 => {
            entry["dtype"] = json!(one_of(
                rng,
                &["F64", "F32", "F16", "BF16", "I64", "U8", "BOOL", "I32"]
            ))
        }
        1 => {
            // The same number of elements, in other dimensions.
            if let Some(shape) = entry["shape"].as_array_mut() {
                let a = place(rng, shape.len());
                match rng.random_range(0..3) {
                    0 => shape.insert(a, json!(1)),
                    1 => shape.reverse(),
                    _ => shape.rotate_left(a),
                }
            }
        }
        2 => {
            if let Some(shape) = entry["shape"].as_array_mut()
                && !shape.is_empty()
            {
                let a = place(rng, shape.len());
                shape[a] = json!(number(rng));
            }
        }
        3 => {
            let end = place(rng, 2);
            if let Some(offset) = entry
                .get_mut("data_offsets")
                .and_then(|offsets| offsets.get_mut(end))
            {
                *offset = json!(number(rng));
            }
        }
        4 => {
            // Two tensors swap names.
            let other = one_of(rng, &tensors).clone();
            let (a, b) = (map[&name].clone(), map[&other].clone());
            map.insert(name, b);
            map.insert(other, a);
        }
        5 => {
            let entry = map.remove(&name).unwrap_or_default();
            map.insert(format!("{name}{}", one_of(rng, &WORDS)), entry);
        }
        _ => {
            // f32 read as f64, or the reverse, with the same number of bytes.
            let wide = entry["dtype"] == json!("F64");
            entry["dtype"] = json!(if wide { "F32" } else { "F64" });
            if let Some(last) = entry["shape"]
                .as_array_mut()
                .and_then(|shape| shape.last_mut())
            {
                let length = last.as_u64().unwrap_or(0);
                *last = json!(if wide {
                    length.wrapping_mul(2)
                } else {
                    length / 2
                });
            }
        }
    }
}
