//! Whether the parts of a checkpoint fit together, before any of it reaches a device: what is let through here must neither
//! stop a run later nor spoil it.

use burn::tensor::{Bytes, DType};
use burn_pack::{Reader, Scalar};

use super::{History, Meta, SavedTensor};
use crate::train::config::MOST_STEPS;

/// More is no run but a damaged file: 300 years.
const LONGEST_SECONDS: f64 = 1e10;
/// Logs of edits, one per field.
const EDIT_LOGS: usize = 6;

/// Tensors: every one has a row per Gaussian, of the width of its name, and numbers in it.
pub(super) fn tensors(tensors: &[SavedTensor]) -> Result<(), String> {
    let means = tensors.iter().find(|(name, ..)| name == "means");
    let n = match means.map(|(_, shape, _)| shape.as_slice()) {
        Some([n, 3]) if *n > 0 => *n,
        _ => return Err("tensor `means` of shape [N, 3] with N > 0 is missing".into()),
    };
    for (name, shape, values) in tensors {
        let fits = match (name.as_str(), shape.as_slice()) {
            ("means" | "log_scales", [rows, 3]) | ("quats", [rows, 4]) => *rows == n,
            ("opacity_logits" | "density.gradients" | "density.views", [rows]) => *rows == n,
            ("sh0", [rows, 1, 3]) => *rows == n,
            ("sh_rest", [rows, 3 | 8 | 15, 3]) => *rows == n,
            _ => false,
        };
        if !fits {
            return Err(format!(
                "tensor `{name}` has shape {shape:?} beside {n} means"
            ));
        }
        // Opacities of 0 and 1 and flat Gaussians are infinite here, and can be.
        let may_be_infinite = matches!(name.as_str(), "opacity_logits" | "log_scales");
        let bad = |value: &f32| value.is_nan() || (value.is_infinite() && !may_be_infinite);
        if let Some(at) = values.iter().position(bad) {
            return Err(format!(
                "tensor `{name}`: value {at} (counted from 0) is {}",
                values[at]
            ));
        }
    }
    let has = |wanted: &str| tensors.iter().any(|(name, ..)| name == wanted);
    if has("density.gradients") != has("density.views") {
        return Err("of `density.gradients` and `density.views` one is missing".into());
    }
    Ok(())
}

/// Everything that is no tensor.
pub(super) fn meta(meta: &Meta) -> Result<(), String> {
    if !(0.0..=LONGEST_SECONDS).contains(&meta.elapsed_seconds) {
        return Err(format!("`elapsed_seconds` is {}", meta.elapsed_seconds));
    }
    if meta.step as u64 > MOST_STEPS {
        return Err(format!("`step` is {}", meta.step));
    }
    let origin = meta.origin_bits.map(f64::from_bits);
    if !origin.iter().all(|x| x.is_finite()) {
        return Err(format!("`origin_bits` are those of {origin:?}"));
    }
    if meta.edits_seen.len() != EDIT_LOGS {
        return Err(format!(
            "`edits_seen` has {} entries instead of {EDIT_LOGS}",
            meta.edits_seen.len()
        ));
    }
    // One edit or two per step at most.
    if let Some(edits) = meta.edits_seen.iter().find(|edits| **edits / 2 > meta.step) {
        return Err(format!("`edits_seen` has {edits} in {} steps", meta.step));
    }
    history(&meta.history, meta.step)
}

/// Steps in order and not beyond the last one, a value for every term.
fn history(history: &History, step: usize) -> Result<(), String> {
    let mut last = 0;
    for (index, record) in history.losses.iter().enumerate() {
        if !(last < record.step && record.step <= step) {
            return Err(format!(
                "`history.losses`: entry {index} (counted from 0) is of step {}, after step {last}, in a run of {step}",
                record.step
            ));
        }
        if record.terms.len() != history.terms.len() || !record.total.is_finite() {
            return Err(format!(
                "`history.losses`: entry {index} (counted from 0) has {} terms instead of {}, and a loss of {}",
                record.terms.len(),
                history.terms.len(),
                record.total
            ));
        }
        last = record.step;
    }
    let counts = history.counts.iter().map(|(at, _)| *at);
    let scores = history.held_out_psnr.iter().map(|(at, _)| *at);
    match counts.chain(scores).find(|at| *at > step) {
        None => Ok(()),
        Some(at) => Err(format!(
            "`history` has an entry of step {at}, in a run of {step}"
        )),
    }
}

/// The optimiser's record: the moments of a parameter have its shape, numbers in them, and the steps and edits that go
/// with them.
pub(super) fn optimizer(record: &[u8], meta: &Meta, tensors: &[SavedTensor]) -> Result<(), String> {
    let params = params(meta, tensors)?;
    let reader = Reader::from_bytes(Bytes::from_bytes_vec(record.to_vec()))
        .map_err(|error| format!("the optimiser's state: {error}"))?;
    let number = |id: u64, field: &str| -> Result<usize, String> {
        let scalar: Option<&Scalar> = reader.scalars().get(&format!("{id}.{field}"));
        scalar
            .and_then(|scalar| usize::try_from(*scalar).ok())
            .ok_or_else(|| format!("the optimiser's state of parameter {id} lacks `{field}`"))
    };
    let mut found = 0;
    for (name, id, shape) in &params {
        let of = |moment: &str| format!("{id}.{moment}");
        let moments = [of("moment_1"), of("moment_2")];
        let names = reader.tensor_names();
        match moments
            .each_ref()
            .map(|moment| names.contains(&moment.as_str()))
        {
            [false, false] => continue,
            [true, true] => found += 2,
            _ => return Err(format!("the optimiser's state of `{name}` lacks a moment")),
        }
        let path = reader.metadata().get(&id.to_string());
        if path != Some(name) {
            return Err(format!("the optimiser takes `{name}` for {path:?}"));
        }
        let (rank, time, edits) = (
            number(*id, "__rank")?,
            number(*id, "time")?,
            number(*id, "edits_seen")?,
        );
        let most = meta.edits_seen.iter().max().copied().unwrap_or(0);
        if rank != shape.len() || time > meta.step || edits > most {
            return Err(format!(
                "the optimiser's state of `{name}` has rank {rank}, {time} steps and {edits} edits, which do not fit the run"
            ));
        }
    }
    // Two moments and three numbers each.
    if (found, found / 2 * 3) != (reader.tensor_names().len(), reader.scalars().len()) {
        return Err("the optimiser's state has entries of no parameter".into());
    }
    let unpacked = reader.into_tensors();
    for tensor in unpacked.map_err(|error| format!("the optimiser's state: {error}"))? {
        moment(tensor, &params)?;
    }
    Ok(())
}

/// Name, id and shape of every parameter; no two have one id.
fn params(meta: &Meta, tensors: &[SavedTensor]) -> Result<Vec<(String, u64, Vec<usize>)>, String> {
    let mut params: Vec<(String, u64, Vec<usize>)> = vec![];
    for (name, shape, _) in tensors {
        if name.starts_with("density.") {
            continue;
        }
        let id = meta.param_ids.iter().find(|(field, _)| field == name);
        let id = id.and_then(|(_, id)| id.parse::<u64>().ok());
        let id = id.ok_or_else(|| format!("the id of parameter `{name}` is missing"))?;
        if let Some((other, ..)) = params.iter().find(|(_, known, _)| *known == id) {
            return Err(format!("parameters `{other}` and `{name}` have one id"));
        }
        params.push((name.clone(), id, shape.clone()));
    }
    Ok(params)
}

fn moment(tensor: burn_pack::Tensor, params: &[(String, u64, Vec<usize>)]) -> Result<(), String> {
    let (name, dtype, shape, owner, bytes) = tensor
        .into_parts()
        .map_err(|error| format!("the optimiser's state: {error}"))?;
    let of = |(_, id, _): &&(String, u64, Vec<usize>)| {
        name.strip_suffix(".moment_1")
            .or(name.strip_suffix(".moment_2"))
            == Some(id.to_string().as_str())
    };
    let Some((field, id, expected)) = params.iter().find(of) else {
        return Err(format!("the optimiser's state `{name}` is of no parameter"));
    };
    if owner != Some(*id) {
        return Err(format!(
            "the optimiser's moment of `{field}` says that it is of {owner:?}"
        ));
    }
    if dtype != DType::F32 || shape[..] != expected[..] {
        return Err(format!(
            "the optimiser's moment of `{field}` is {dtype:?} of shape {shape:?}, not F32 of {expected:?}"
        ));
    }
    let values = bytes.as_chunks::<4>().0;
    let finite = |bytes: &[u8; 4]| f32::from_le_bytes(*bytes).is_finite();
    match values.iter().position(|bytes| !finite(bytes)) {
        None => Ok(()),
        Some(at) => Err(format!(
            "the optimiser's moment of `{field}`: value {at} (counted from 0) is not finite"
        )),
    }
}
