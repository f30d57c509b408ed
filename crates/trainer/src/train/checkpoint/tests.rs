//! Damaged checkpoints: every part that does not fit the others is refused when the file is read, by name.

use std::path::Path;
use std::sync::Arc;

use burn::tensor::Device;
use burn_pack::{Reader, Scalar, Tensor, Writer};

use super::*;
use crate::train::{TrainConfig, Trainer};
use splat_data::{Capture, CaptureOptions};

fn capture() -> Arc<Capture> {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
    let options = CaptureOptions {
        downscale: 8,
        ..CaptureOptions::default()
    };
    let mut capture = Capture::load(folder.as_ref(), &options).unwrap();
    capture.points.truncate(40);
    Arc::new(capture)
}

fn config(steps: usize) -> TrainConfig {
    TrainConfig {
        steps,
        ..TrainConfig::default()
    }
}

/// The state after three steps.
fn saved() -> Checkpoint {
    let trainer = Trainer::builder().capture(capture()).config(config(3));
    let trained = trainer.device(Device::flex()).build().unwrap().run();
    trained.unwrap().checkpoint().unwrap()
}

/// The message of reading a checkpoint that was damaged before it was written.
fn refused(checkpoint: &Checkpoint) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint.safetensors");
    // What is plainly wrong is not even written.
    let read = checkpoint.save(&path).and_then(|()| {
        let bytes = std::fs::read(&path).unwrap();
        Checkpoint::parse(Path::new("checkpoint.safetensors"), &bytes)
    });
    let message = read.expect_err("the checkpoint is damaged").to_string();
    assert!(
        message.contains("checkpoint.safetensors: not a usable"),
        "{message}"
    );
    message
}

fn values<'a>(checkpoint: &'a mut Checkpoint, name: &str) -> &'a mut Vec<f32> {
    let found = checkpoint.tensors.iter_mut().find(|(n, ..)| n == name);
    &mut found.expect("a tensor of the checkpoint").2
}

#[test]
fn values_that_are_no_numbers_are_named() {
    let good = saved();
    for name in [
        "means",
        "quats",
        "opacity_logits",
        "log_scales",
        "density.views",
    ] {
        let mut bad = good.clone();
        values(&mut bad, name)[7] = f32::NAN;
        let message = refused(&bad);
        assert!(message.contains(&format!("`{name}`: value 7")), "{message}");
    }
    let mut bad = good.clone();
    values(&mut bad, "sh0")[0] = f32::INFINITY;
    assert!(refused(&bad).contains("`sh0`: value 0"));
    let mut bad = good;
    bad.tensors.retain(|(name, ..)| name != "density.gradients");
    assert!(refused(&bad).contains("one is missing"));
}

/// Each of these ended a resumed run by a panic, or went on with other numbers than were meant.
#[test]
fn a_run_that_cannot_have_been_is_refused() {
    let good = saved();
    let damaged = |damage: &dyn Fn(&mut Meta)| {
        let mut bad = good.clone();
        damage(&mut bad.meta);
        refused(&bad)
    };
    assert!(damaged(&|meta| meta.history.losses[0].step = 0).contains("`history.losses`: entry 0"));
    assert!(damaged(&|meta| meta.history.losses[2].step = 1).contains("`history.losses`: entry 2"));
    assert!(damaged(&|meta| meta.history.losses[2].step = 9).contains("`history.losses`: entry 2"));
    assert!(damaged(&|meta| meta.history.losses[1].terms.clear()).contains("0 terms"));
    assert!(damaged(&|meta| meta.history.counts[0].0 = 99).contains("step 99"));
    assert!(damaged(&|meta| meta.elapsed_seconds = 1.8e19).contains("`elapsed_seconds`"));
    assert!(damaged(&|meta| meta.step = usize::MAX).contains("`step`"));
    assert!(damaged(&|meta| meta.elapsed_seconds = -1.0).contains("`elapsed_seconds`"));
    assert!(damaged(&|meta| meta.edits_seen = vec![0; 5]).contains("`edits_seen` has 5"));
    assert!(damaged(&|meta| meta.edits_seen[0] = usize::MAX).contains("`edits_seen`"));
    assert!(damaged(&|meta| meta.param_ids[1].1 = meta.param_ids[0].1.clone()).contains("one id"));
    assert!(damaged(&|meta| meta.param_ids[2].1 = "7".into()).contains("optimiser"));
}

/// Name, type, shape, id and bytes of a tensor in the optimiser's record.
type Packed = (
    String,
    burn_pack::DType,
    burn_pack::Shape,
    Option<u64>,
    Bytes,
);

/// The message for a checkpoint whose optimiser's record was changed and packed again.
fn repacked(
    checkpoint: &Checkpoint,
    change: impl FnOnce(&mut Vec<Packed>, &mut Vec<(String, Scalar)>),
) -> String {
    let record = Bytes::from_bytes_vec(checkpoint.optimizer.clone());
    let reader = Reader::from_bytes(record).unwrap();
    let mut scalars: Vec<_> = reader.scalars().clone().into_iter().collect();
    let paths = reader.metadata().clone();
    let tensors = reader.into_tensors().unwrap().into_iter();
    let mut tensors: Vec<_> = tensors.map(|tensor| tensor.into_parts().unwrap()).collect();
    change(&mut tensors, &mut scalars);
    let tensors = tensors
        .into_iter()
        .map(|(name, dtype, shape, id, bytes)| Tensor::new(name, dtype, shape, id, bytes));
    let writer = Writer::new(tensors.collect());
    let add = |writer: Writer, (key, value): &(String, Scalar)| writer.with_scalar(key, *value);
    let writer = scalars.iter().fold(writer, add);
    let writer = paths.iter().fold(writer, |writer, (key, value)| {
        writer.with_metadata(key, value)
    });
    let mut bad = checkpoint.clone();
    bad.optimizer = writer.into_bytes().unwrap().to_vec();
    refused(&bad)
}

/// Moments of another shape ended the first step by a panic; NaN in them would have spread to the model.
#[test]
fn moments_that_do_not_fit_their_parameter_are_refused() {
    let good = saved();
    let shape = repacked(&good, |tensors, _| {
        let count = tensors[0].4.len() / 4;
        tensors[0].2 = vec![count].into();
    });
    assert!(shape.contains("the optimiser's moment of"), "{shape}");
    let rows = repacked(&good, |tensors, _| {
        let means = tensors
            .iter_mut()
            .find(|tensor| tensor.2[..] == [40, 3])
            .unwrap();
        means.2 = vec![39, 3].into();
        means.4 = Bytes::from_bytes_vec(means.4[..39 * 12].to_vec());
    });
    assert!(
        rows.contains("[39, 3]") && rows.contains("[40, 3]"),
        "{rows}"
    );
    let kind = repacked(&good, |tensors, _| tensors[1].1 = burn_pack::DType::I32);
    assert!(kind.contains("I32"), "{kind}");
    let value = repacked(&good, |tensors, _| {
        let mut bytes = tensors[2].4.to_vec();
        bytes[8..12].copy_from_slice(&f32::NAN.to_le_bytes());
        tensors[2].4 = Bytes::from_bytes_vec(bytes);
    });
    assert!(
        value.contains("value 2 (counted from 0) is not finite"),
        "{value}"
    );
    let owner = repacked(&good, |tensors, _| tensors[0].3 = None);
    assert!(owner.contains("says that it is of None"), "{owner}");
    let missing = repacked(&good, |tensors, _| drop(tensors.remove(3)));
    assert!(missing.contains("lacks a moment"), "{missing}");
    let time = repacked(&good, |_, scalars| {
        let time = scalars
            .iter_mut()
            .find(|(key, _)| key.ends_with(".time"))
            .unwrap();
        time.1 = Scalar::UInt(u64::MAX);
    });
    assert!(time.contains("do not fit the run"), "{time}");
    let stranger = repacked(&good, |_, scalars| {
        scalars.push(("5.__rank".into(), Scalar::UInt(99)));
    });
    assert!(stranger.contains("of no parameter"), "{stranger}");
}

/// The losses of a run with other terms have no place in its table.
#[test]
fn a_checkpoint_of_another_loss_is_refused() {
    let loss =
        |_: &crate::TargetView, rendered: &splat_model::ops::Rendered| Ok(rendered.alpha().mean());
    let trainer = Trainer::builder().capture(capture()).config(config(9));
    let trainer = trainer.device(Device::flex()).loss(loss).resume(saved());
    let message = trainer.build().map(drop).unwrap_err().to_string();
    assert!(message.contains("a loss of the terms"), "{message}");
}
