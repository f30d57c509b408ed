//! Gradients of a projection do not depend on which others are requested; splats on the border are
//! culled.

use burn::tensor::{Device, Tensor, TensorData};

use super::devices;
use crate::{ImageSize, ProjectSettings, project};

/// Gradients of means, quaternions, scales, poses and intrinsics, if tracked.
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

/// Packed row of a Gaussian on the axis of a camera with principal point (cx, cy), where its mean
/// therefore lies.
fn on_axis(device: &Device, size: ImageSize, [cx, cy]: [f32; 2]) -> [f32; 9] {
    let at = |values: Vec<f32>| {
        let width = values.len();
        Tensor::<2>::from_data(TensorData::new(values, [1, width]), device)
    };
    let mut viewmat = [0.0; 16];
    for i in 0..4 {
        viewmat[5 * i] = 1.0;
    }
    // The Jacobian is that at the mean, wherever the image is.
    let settings = ProjectSettings {
        clamp_margin: 10.0,
        ..Default::default()
    };
    let projected = project(
        at(vec![0.0, 0.0, 2.0]),
        at(vec![1.0, 0.2, 0.1, 0.3]),
        at(vec![0.1, 0.2, 0.15]),
        at(viewmat.to_vec()).reshape([1, 4, 4]),
        at(vec![40.0, 42.0, cx, cy]),
        size,
        &settings,
    );
    let row = projected.unwrap().packed().into_data();
    row.try_into_vec::<f32>().unwrap().try_into().unwrap()
}

#[test]
fn a_splat_whose_box_only_touches_the_border_is_culled() {
    // Large enough that border + extent - extent equals the border: both sums have equally fine
    // digits.
    let size = ImageSize {
        width: 40,
        height: 40,
    };
    let (width, height) = (size.width as f32, size.height as f32);
    for (name, device) in devices() {
        let middle = on_axis(&device, size, [20.0, 20.0]);
        let [.., x, y] = middle;
        let extents = |[cx, cy]: [f32; 2]| on_axis(&device, size, [cx, cy])[7..].to_vec();
        assert!(x > 1.0 && y > 1.0, "{name}: {middle:?}");
        let (right, below) = (width + x, height + y);
        assert_eq!(
            [right - x, below - y],
            [width, height],
            "{name}: {middle:?}"
        );
        for [cx, cy] in [[-x, 20.0], [right, 20.0], [20.0, -y], [20.0, below]] {
            assert_eq!(extents([cx, cy]), [0.0, 0.0], "{name}: at {cx}, {cy}");
            let nudged = |at: f32, middle: f32| at + (middle - at) * 1e-4;
            let inside = [nudged(cx, 20.0), nudged(cy, 20.0)];
            assert_eq!(extents(inside), [x, y], "{name}: at {inside:?}");
        }
    }
}
