//! Noise of the means: the same on every device, and none where there should be none.

use burn::tensor::{DType, Device, Tensor, TensorData};

use super::devices;
use crate::{OpError, Perturbation, perturb_means};

const NOISE: Perturbation = Perturbation {
    amount: 80.0,
    opacity: 0.005,
    steepness: 100.0,
    seed: 1 << 40 | 7,
    step: 901,
};

/// Offsets of Gaussians at the origin.
fn offsets(
    (device, dtype): (&Device, DType),
    gaussians: &[([f64; 4], [f64; 3], f64)],
    noise: &Perturbation,
) -> Vec<f64> {
    let n = gaussians.len();
    let options = (device, dtype);
    let two = |values: Vec<f64>, width: usize| {
        Tensor::<2>::from_data(TensorData::new(values, [n, width]), options)
    };
    let quats = gaussians.iter().flat_map(|(quat, ..)| *quat).collect();
    let scales = gaussians.iter().flat_map(|(_, scale, _)| *scale).collect();
    let logits: Vec<f64> = gaussians.iter().map(|(.., logit)| *logit).collect();
    let logits = Tensor::<1>::from_data(TensorData::new(logits, [n]), options);
    let means = Tensor::<2>::zeros([n, 3], options);
    let moved = perturb_means(means, two(quats, 4), two(scales, 3), logits, noise).unwrap();
    moved.into_data().convert::<f64>().try_into_vec().unwrap()
}

#[test]
fn noise_is_a_function_of_seed_step_and_row_on_every_device() {
    let gaussians: Vec<_> = (0..300)
        .map(|i| {
            let turn = f64::from(i) * 0.1;
            let quat = [turn.cos(), 0.3, -turn.sin(), 0.7];
            (quat, [-3.0, -4.0 + 0.01 * f64::from(i), -2.0], -6.0)
        })
        .collect();
    let expected = offsets((&Device::flex(), DType::F64), &gaussians, &NOISE);
    for (name, device) in devices() {
        let single = (&device, DType::F32);
        let ours = offsets(single, &gaussians, &NOISE);
        for (row, (ours, expected)) in ours.chunks(3).zip(expected.chunks(3)).enumerate() {
            let length = expected.iter().map(|x| x * x).sum::<f64>().sqrt();
            for (ours, expected) in ours.iter().zip(expected) {
                let off = (ours - expected).abs();
                assert!(
                    off < 1e-4 * length,
                    "{name}, row {row}: {ours} not {expected}"
                );
            }
        }
        let other = Perturbation { step: 902, ..NOISE };
        assert_ne!(offsets(single, &gaussians, &other), ours, "{name}");
        let other = Perturbation { seed: 8, ..NOISE };
        assert_ne!(offsets(single, &gaussians, &other), ours, "{name}");
    }
}

#[test]
fn what_cannot_move_stays() {
    let unit = [1.0, 0.0, 0.0, 0.0];
    let gaussians = [
        (unit, [0.0; 3], 3.0),                // opaque
        (unit, [0.0; 3], f64::INFINITY),      // quite opaque
        ([0.0; 4], [0.0; 3], -6.0),           // no axes
        (unit, [f64::NEG_INFINITY; 3], -6.0), // no size
        (unit, [f64::NAN, 0.0, 0.0], -6.0),   // no number
        (unit, [88.0; 3], -6.0),              // beyond all numbers
        (unit, [0.0; 3], f64::NEG_INFINITY),  // transparent: moves
    ];
    for (name, device) in devices() {
        let moved = offsets((&device, DType::F32), &gaussians, &NOISE);
        let moves: Vec<bool> = moved
            .chunks(3)
            .map(|offset| offset.iter().any(|x| *x != 0.0))
            .collect();
        assert!(moved.iter().all(|x| x.is_finite()), "{name}: {moved:?}");
        let expected = [false, false, false, false, false, false, true];
        assert_eq!(moves, expected, "{name}: {moved:?}");
    }
}

#[test]
fn what_does_not_fit_is_an_error() {
    let device = Device::flex();
    let tensor = |n: usize, width: usize| Tensor::<2>::zeros([n, width], &device);
    let logits = Tensor::<1>::zeros([3], &device);
    let result = perturb_means(tensor(3, 3), tensor(2, 4), tensor(3, 3), logits, &NOISE);
    assert!(matches!(
        result,
        Err(OpError::Shape {
            tensor: "quats",
            ..
        })
    ));
    let logits = Tensor::<1>::zeros([0], &device);
    let none = perturb_means(tensor(0, 3), tensor(0, 4), tensor(0, 3), logits, &NOISE);
    assert_eq!(none.unwrap().dims(), [0, 3]);
}
