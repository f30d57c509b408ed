//! Damaged checkpoints: every inconsistent part is refused by name when the file is read.

use std::path::Path;
use std::sync::Arc;

use burn::tensor::Device;
use burn_pack::Scalar;

use super::*;
use crate::train::{TrainSettings, Trainer};
use splat_data::{Capture, CaptureSettings};

fn capture() -> Arc<Capture> {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/saharov");
    let options = CaptureSettings {
        downscale: 8,
        ..CaptureSettings::default()
    };
    let mut capture = Capture::load(folder, &options).unwrap();
    capture.points.truncate(40);
    Arc::new(capture)
}

fn config(steps: usize) -> TrainSettings {
    TrainSettings {
        steps,
        ..TrainSettings::default()
    }
}

/// The state after three steps.
fn saved() -> Checkpoint {
    let trainer = Trainer::builder(capture()).settings(config(3));
    let trained = trainer.device(Device::flex()).build().unwrap().run();
    trained.unwrap().checkpoint().unwrap()
}

/// Error from reading a checkpoint that was damaged before it was written.
fn refused(checkpoint: &Checkpoint) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint.safetensors");
    // Obvious damage is not even written.
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
        "model.means",
        "model.quats",
        "model.opacity_logits",
        "model.log_scales",
        "model.sh0.moment_1",
        "strategy.views",
    ] {
        let mut bad = good.clone();
        values(&mut bad, name)[7] = f32::NAN;
        let message = refused(&bad);
        assert!(message.contains(&format!("`{name}`: value 7")), "{message}");
    }
    let mut bad = good.clone();
    values(&mut bad, "model.sh0")[0] = f32::INFINITY;
    assert!(refused(&bad).contains("`model.sh0`: value 0"));
    let mut bad = good;
    values(&mut bad, "model.means.moment_2")[3] = -1.0;
    assert!(refused(&bad).contains("`model.means.moment_2`: value 3"));
}

/// Each of these used to make a resumed run panic, or continue with wrong numbers.
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
    let late = |meta: &mut Meta| {
        let time = Scalar::UInt(u64::MAX);
        meta.scalars.insert("model.means.time".into(), time.into());
    };
    assert!(damaged(&late).contains("`model.means.time`"));
}

/// Error from resuming from a checkpoint that is damaged but readable.
fn not_resumed(checkpoint: Checkpoint) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint.safetensors");
    checkpoint.save(&path).unwrap();
    let trainer = Trainer::builder(capture()).settings(config(3));
    let trainer = trainer.device(Device::flex());
    let trainer = trainer.resume(Checkpoint::load(&path).unwrap()).build();
    let message = trainer.map(drop).expect_err("it fits no run").to_string();
    assert!(
        message.contains("checkpoint.safetensors: not a usable"),
        "{message}"
    );
    message
}

/// Moments of the wrong shape used to panic in the first step; missing parts would have restarted.
#[test]
fn parts_that_do_not_fit_the_run_are_refused_when_it_goes_on() {
    let good = saved();
    let damaged = |damage: &dyn Fn(&mut Vec<SavedTensor>)| {
        let mut bad = good.clone();
        damage(&mut bad.tensors);
        not_resumed(bad)
    };
    let shape = |name: &'static str, shape: &'static [usize]| {
        move |tensors: &mut Vec<SavedTensor>| {
            let tensor = tensors
                .iter_mut()
                .find(|(found, ..)| found == name)
                .unwrap();
            tensor.1 = shape.to_vec();
            tensor.2.resize(shape.iter().product(), 0.0);
        }
    };
    let remove = |name: &'static str| {
        move |tensors: &mut Vec<SavedTensor>| tensors.retain(|(found, ..)| found != name)
    };
    let rows = damaged(&shape("model.means.moment_1", &[39, 3]));
    assert!(
        rows.contains("`means`") && rows.contains("[39, 3]"),
        "{rows}"
    );
    let rank = damaged(&shape("model.quats.moment_2", &[160]));
    assert!(rank.contains("`quats`") && rank.contains("[160]"), "{rank}");
    let sums = damaged(&shape("strategy.views", &[7]));
    assert!(sums.contains("adc") && sums.contains("[40]"), "{sums}");
    let missing = damaged(&remove("model.quats"));
    assert!(missing.contains("`quats` is missing"), "{missing}");
    let missing = damaged(&remove("strategy.gradients"));
    assert!(missing.contains("one is missing"), "{missing}");
    let missing = damaged(&remove("model.sh0.moment_1"));
    assert!(missing.contains("`sh0`"), "{missing}");
    let stranger = damaged(&|tensors| tensors.push(("model.heat".into(), vec![1], vec![0.0])));
    assert!(stranger.contains("`heat` is no field"), "{stranger}");
    let stranger = damaged(&|tensors| tensors.push(("hook.heat.x".into(), vec![1], vec![0.0])));
    assert!(stranger.contains("belongs to nothing"), "{stranger}");
}

/// Losses of a run with other terms do not fit its table.
#[test]
fn a_checkpoint_of_another_loss_is_refused() {
    let loss =
        |_: &crate::TargetView, rendered: &splat_model::ops::Rendered| Ok(rendered.alpha().mean());
    let trainer = Trainer::builder(capture()).settings(config(9));
    let trainer = trainer.device(Device::flex()).loss(loss).resume(saved());
    let message = trainer.build().map(drop).unwrap_err().to_string();
    assert!(message.contains("a loss of the terms"), "{message}");
}
