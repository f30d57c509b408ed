//! Whether the parts of a checkpoint fit together, before any of it reaches a device: what is let
//! through here must neither stop a run later nor spoil it. What only the model, the strategy and
//! the hooks know is checked where they are restored.

use burn_pack::Scalar;

use super::{History, Meta, SavedTensor};
use crate::train::settings::MOST_STEPS;

/// More is no run but a damaged file: 300 years.
const LONGEST_SECONDS: f64 = 1e10;
/// The means, which every model has.
pub(super) const MEANS: &str = "model.means";
/// End of the name of an optimiser's count of steps.
const TIME: &str = ".time";

/// Tensors: there are means, the fields that every model of Gaussians has are as wide as they are,
/// and all have numbers in them.
pub(super) fn tensors(tensors: &[SavedTensor]) -> Result<(), String> {
    let means = tensors.iter().find(|(name, ..)| name == MEANS);
    let n = match means.map(|(_, shape, _)| shape.as_slice()) {
        Some([n, 3]) if *n > 0 => *n,
        _ => {
            return Err(format!(
                "tensor `{MEANS}` of shape [N, 3] with N > 0 is missing"
            ));
        }
    };
    for (name, shape, values) in tensors {
        let fits = match (
            name.strip_prefix("model.").unwrap_or_default(),
            shape.as_slice(),
        ) {
            ("means" | "log_scales" | "sh0", shape) => shape == [n, 3],
            ("quats", shape) => shape == [n, 4],
            ("opacity_logits", shape) => shape == [n, 1],
            ("sh_rest", [rows, 9 | 24 | 45]) => *rows == n,
            ("sh_rest", _) => false,
            _ => true,
        };
        if !fits {
            return Err(format!(
                "tensor `{name}` has shape {shape:?} beside {n} means"
            ));
        }
        // Opacities of 0 and 1 and flat Gaussians are infinite here, and can be.
        let may_be_infinite = matches!(name.as_str(), "model.opacity_logits" | "model.log_scales");
        let is_square = name.ends_with(".moment_2");
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
    let late = |(name, value): &(&String, &Scalar)| {
        name.ends_with(TIME) && !usize::try_from(**value).is_ok_and(|time| time <= meta.step)
    };
    if let Some((name, value)) = meta.scalars.iter().find(late) {
        return Err(format!(
            "`{name}` is {value:?}, in a run of {} steps",
            meta.step
        ));
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
