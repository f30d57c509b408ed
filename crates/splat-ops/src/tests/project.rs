//! Gradients of a projection do not depend on which others are asked for.

use burn::tensor::{Device, Tensor, TensorData};

use super::devices;
use crate::{ImageSize, ProjectSettings, project};

/// Gradients of means, quaternions, scales, poses and intrinsics, of those that are tracked.
fn gradients(device: &Device, tracked: [bool; 5]) -> [Option<Vec<f32>>; 5] {
    const POSES: [f32; 32] = [
        1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, -0.2, 0.0, 0.0, 1.0, 3.0, 0.0, 0.0, 0.0, 1.0, //
        0.8, 0.0, 0.6, 0.0, 0.0, 1.0, 0.0, 0.3, -0.6, 0.0, 0.8, 4.0, 0.0, 0.0, 0.0, 1.0,
    ];
    let values: [(Vec<f32>, Vec<usize>); 5] = [
        (
            vec![0.0, 0.1, 0.2, -0.4, 0.3, 0.5, 0.6, -0.2, -0.3],
            vec![3, 3],
        ),
        (
            vec![1.0, 0.2, 0.1, 0.0, 0.9, -0.3, 0.2, 0.4, 0.5, 0.5, -0.5, 0.5],
            vec![3, 4],
        ),
        (
            vec![0.1, 0.2, 0.3, 0.2, 0.1, 0.15, 0.3, 0.1, 0.2],
            vec![3, 3],
        ),
        (POSES.to_vec(), vec![2, 4, 4]),
        (
            vec![40.0, 42.0, 16.0, 12.0, 38.0, 41.0, 15.0, 13.0],
            vec![2, 4],
        ),
    ];
    let mut at = 0;
    let [means, quats, scales, poses, intrinsics] = values.map(|(values, shape)| {
        let leaf = Tensor::<1>::from_data(TensorData::from(&values[..]), device);
        let leaf = leaf.set_require_grad(tracked[at]);
        at += 1;
        (leaf, shape)
    });
    let matrix = |(leaf, shape): &(Tensor<1>, Vec<usize>)| -> Tensor<2> {
        leaf.clone().reshape([shape[0], shape[1]])
    };
    let size = ImageSize {
        width: 32,
        height: 24,
    };
    let projected = project(
        matrix(&means),
        matrix(&quats),
        matrix(&scales),
        poses.0.clone().reshape([2, 4, 4]),
        matrix(&intrinsics),
        size,
        &ProjectSettings::default(),
    );
    let packed = projected.unwrap().packed();
    let weights: Vec<f32> = (0..2 * 3 * 9)
        .map(|i| ((i * 7) % 11) as f32 - 5.0)
        .collect();
    let weights = Tensor::<3>::from_data(TensorData::new(weights, [2, 3, 9]), device);
    let grads = (packed * weights).sum().backward();
    [means, quats, scales, poses, intrinsics].map(|(leaf, _)| {
        let grad = leaf.grad(&grads)?.into_data();
        Some(grad.try_into_vec::<f32>().unwrap())
    })
}

#[test]
fn a_gradient_alone_is_the_same_as_with_all_others() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let all = gradients(&device, [true; 5]);
        for i in 0..5 {
            let alone = gradients(&device, core::array::from_fn(|j| i == j));
            let expected = all[i].as_ref().unwrap();
            assert!(expected.iter().any(|g| *g != 0.0), "{name}: {i}");
            assert_eq!(alone[i].as_ref(), Some(expected), "{name}: {i}");
        }
    }
}
