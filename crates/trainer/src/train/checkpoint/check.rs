//! Consistency checks of a checkpoint, before any of it reaches a device: data that passes must
//! neither stop a run later nor corrupt it. Properties that only the model, the strategy and the
//! hooks know are checked when those are restored.

use burn_pack::Scalar;

use super::{History, Meta, SavedScalar, SavedTensor};
use crate::train::settings::MOST_STEPS;

/// Longest plausible run: 300 years.
const LONGEST_SECONDS: f64 = 1e10;
/// Prefix of the model's tensors and numbers.
const MODEL: &str = "model.";
/// Suffix of an optimiser's step count.
const TIME: &str = ".time";

/// Checks tensors: a model exists, and all values are numbers.
pub(super) fn tensors(tensors: &[SavedTensor]) -> Result<(), String> {
    if !tensors.iter().any(|(name, ..)| name.starts_with(MODEL)) {
        return Err("no tensor of a model (`model.…`) is there".to_owned());
    }
    for (name, _, values) in tensors {
        // Infinite values are valid here: opacities of 0 and 1, and flat Gaussians.
        let may_be_infinite = matches!(name.as_str(), "model.opacity_logits" | "model.log_scales");
        let is_square = name.starts_with(MODEL) && name.ends_with(".moment_2");
        let bad = |value: &f32| {
            value.is_nan()
                || (value.is_infinite() && !may_be_infinite)
                || (is_square && *value < 0.0)
        };
        if let Some(at) = values.iter().position(bad) {
            return Err(format!(
                "tensor `{name}`: value {at} (counted from 0) is {}",
                values[at]
            ));
        }
    }
    Ok(())
}

/// Checks everything except tensors.
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
    let late = |(name, value): &(&String, &SavedScalar)| {
        let time = usize::try_from(Scalar::from(**value));
        name.starts_with(MODEL) && name.ends_with(TIME) && !time.is_ok_and(|time| time <= meta.step)
    };
    if let Some((name, value)) = meta.scalars.iter().find(late) {
        return Err(format!(
            "`{name}` is {value:?}, in a run of {} steps",
            meta.step
        ));
    }
    history(&meta.history, meta.step)
}

/// Checks that steps are ordered and not beyond the last one, with a value for every term.
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
    let reduced = history.sh_reduction.iter().map(|reduced| reduced.step);
    match counts.chain(scores).chain(reduced).find(|at| *at > step) {
        None => Ok(()),
        Some(at) => Err(format!(
            "`history` has an entry of step {at}, in a run of {step}"
        )),
    }
}
