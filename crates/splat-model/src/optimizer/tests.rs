//! Moments follow their rows, with every optimiser.

use burn::optim::momentum::MomentumConfig;
use burn::optim::{AdamConfig, AdamWConfig, RmsPropConfig, SgdConfig};
use burn::tensor::{Device, Int, Tensor, TensorData};

use super::*;

type Named = (&'static str, FieldOptimizer);

/// Optimisers whose moments stay on the device, and others.
fn optimizers() -> Vec<Named> {
    let momentum = MomentumConfig::new().with_momentum(0.8);
    vec![
        ("ours", SplatAdam::new().into()),
        ("Adam", AdamConfig::new().build().into()),
        (
            "AMSGrad",
            AdamConfig::new().with_amsgrad(true).build().into(),
        ),
        ("AdamW", AdamWConfig::new().build().into()),
        (
            "Adam through the host",
            ThroughHost(AdamConfig::new().build()).into(),
        ),
        (
            "RMSProp",
            ThroughHost(RmsPropConfig::new().with_momentum(0.7).build()).into(),
        ),
        (
            "SGD",
            ThroughHost(SgdConfig::new().with_momentum(Some(momentum)).build()).into(),
        ),
    ]
}

fn values(tensor: Tensor<2>) -> Vec<f32> {
    tensor.into_data().try_into_vec().unwrap()
}

/// Gradient of row `row` of the first model at a step.
fn gradient(row: usize, step: usize) -> [f32; 2] {
    let phase = row as f32 * 1.7 + step as f32;
    [phase.sin(), 10.0 * phase.cos()]
}

/// Steps rows that were rows `rows` of the first model.
fn step(
    optimizer: &mut FieldOptimizer,
    value: Tensor<2>,
    rows: &[usize],
    step: usize,
) -> Tensor<2> {
    let gradients: Vec<f32> = rows.iter().flat_map(|row| gradient(*row, step)).collect();
    let gradients = Tensor::<1>::from_floats(gradients.as_slice(), &value.device());
    optimizer.step(0.1, value, gradients.reshape([rows.len(), 2]))
}

fn first(rows: &[usize], device: &Device) -> Tensor<2> {
    let values: Vec<f32> = rows.iter().flat_map(|row| [*row as f32, -1.0]).collect();
    Tensor::<1>::from_floats(values.as_slice(), device).reshape([rows.len(), 2])
}

fn gather(source: &[i32], restarts: &[bool], device: &Device) -> MomentEdit {
    MomentEdit::Gather {
        source: Tensor::<1, Int>::from_ints(source, device),
        restarts: Tensor::from_bool(TensorData::from(restarts), device),
    }
}

/// After an edit, rows train as if they had always been in their new positions.
#[test]
fn moments_follow_their_rows() {
    let device = Device::flex();
    for ((name, mut edited), (_, mut straight)) in optimizers().into_iter().zip(optimizers()) {
        let mut value = first(&[0, 1, 2], &device);
        let mut expected = first(&[2, 1], &device);
        for at in 0..3 {
            value = step(&mut edited, value, &[0, 1, 2], at);
            expected = step(&mut straight, expected, &[2, 1], at);
        }
        edited.edit_rows(&gather(&[2, 1], &[false, false], &device));
        value = value.select(0, Tensor::from_ints([2, 1], &device));
        for at in 3..6 {
            value = step(&mut edited, value, &[2, 1], at);
            expected = step(&mut straight, expected, &[2, 1], at);
        }
        assert_eq!(values(value), values(expected), "{name}");
    }
}

#[test]
fn rows_that_start_anew_have_no_moments() {
    let device = Device::flex();
    let mut adam = FieldOptimizer::from(SplatAdam::new());
    let value = step(&mut adam, first(&[0, 1, 2], &device), &[0, 1, 2], 0);
    let before = adam.save().tensors["moment_1"].try_to_vec::<f32>().unwrap();
    adam.edit_rows(&gather(&[2, 1, 1], &[false, false, true], &device));
    let after = adam.save().tensors["moment_1"].try_to_vec::<f32>().unwrap();
    assert_eq!(
        after,
        [before[4], before[5], before[2], before[3], 0.0, 0.0]
    );
    adam.edit_rows(&MomentEdit::Restart);
    let after = adam.save().tensors["moment_2"].try_to_vec::<f32>().unwrap();
    assert_eq!((after, value.dims()), (vec![0.0; 6], [3, 2]));
}

/// A restored state continues with the same numbers.
#[test]
fn a_state_that_was_saved_goes_on() {
    let device = Device::flex();
    for ((name, mut whole), (_, mut resumed)) in optimizers().into_iter().zip(optimizers()) {
        let mut value = first(&[0, 1], &device);
        for at in 0..2 {
            value = step(&mut whole, value, &[0, 1], at);
        }
        resumed.restore(whole.save(), [2, 2], &device).unwrap();
        for at in 2..4 {
            let expected = step(&mut whole, value.clone(), &[0, 1], at);
            let same = step(&mut resumed, value, &[0, 1], at);
            assert_eq!(values(same), values(expected.clone()), "{name}");
            value = expected;
        }
    }
}

#[test]
fn a_state_of_another_shape_or_optimiser_is_refused() {
    let device = Device::flex();
    let mut adam = FieldOptimizer::from(SplatAdam::new());
    step(&mut adam, first(&[0, 1], &device), &[0, 1], 0);
    let saved = adam.save();
    let message = adam.restore(saved.clone(), [3, 2], &device).unwrap_err();
    assert!(message.contains("[2, 2] instead of [3, 2]"), "{message}");
    let mut other = saved;
    other.tensors.remove("moment_2");
    let message = adam.restore(other, [2, 2], &device).unwrap_err();
    assert!(message.contains("another optimiser"), "{message}");
}

#[test]
fn records_are_put_under_names_and_taken_out_again() {
    let mut inner = StateRecord::default();
    inner.scalars.insert("time".into(), 7usize.into());
    let mut record = StateRecord::default();
    record.put_under("model", inner.clone());
    record.put_under("models", inner.clone());
    assert_eq!(record.take_under("model"), inner);
    assert_eq!(record.scalars.keys().collect::<Vec<_>>(), ["models.time"]);
}

/// A restarted row has zero moments, whatever they were.
#[test]
fn a_moment_that_is_not_a_number_does_not_survive_a_restart() {
    let device = Device::flex();
    let moment = Tensor::<2>::from_floats([[f32::NAN, 1.0], [2.0, f32::INFINITY]], &device);
    let edited = gather(&[0, 1], &[true, true], &device).apply(moment);
    assert_eq!(values(edited), [0.0; 4]);
}
