//! Sums of screen gradients against the formula, on every device.

use burn::tensor::{Tensor, TensorData};

use super::devices;
use crate::{ImageSize, Projected, ScreenStatistics};

/// Two cameras, five Gaussians.
#[test]
fn lengths_in_half_images_are_summed_where_seen_and_finite() {
    let size = ImageSize {
        width: 6,
        height: 10,
    };
    // 0.7 would give every row of nine nearly the same phase, and nothing would be seen.
    let packed: Vec<f32> = (0..2 * 5 * 9).map(|i| (i as f32 * 0.5).sin()).collect();
    let broken = [(9, f32::NAN), (9 * 5 + 1, f32::INFINITY), (9 * 8, 3e38)];
    for (name, device) in devices() {
        let mut values = packed.clone();
        for (at, value) in broken {
            values[at] = value;
        }
        let tensor = Tensor::<3>::from_data(TensorData::new(values.clone(), [2, 5, 9]), &device);
        let projected = Projected::from_packed(tensor.clone(), size).unwrap();
        let start = Tensor::<1>::from_floats([1.0, 2.0, 3.0, 4.0, 5.0], &device);
        let held = start.clone();
        let sums = ScreenStatistics {
            gradients: start.clone(),
            views: start,
        };
        let sums = sums.add(tensor, &projected).unwrap();
        let to_host = |x: Tensor<1>| x.into_data().try_into_vec::<f32>().unwrap();
        assert_eq!(to_host(held), [1.0, 2.0, 3.0, 4.0, 5.0], "{name}");
        let (gradients, views) = (to_host(sums.gradients), to_host(sums.views));
        for n in 0..5 {
            let (mut length, mut count) = (n as f32 + 1.0, n as f32 + 1.0);
            for row in [n, 5 + n].map(|row| &values[9 * row..9 * row + 9]) {
                if row[7] > 0.0 {
                    let this = (6.0 * row[0]).hypot(10.0 * row[1]);
                    let broken = broken.iter().any(|(_, value)| row[..2].contains(value));
                    length += if this.is_nan() || broken { 0.0 } else { this };
                    count += 1.0;
                }
            }
            assert_eq!(views[n], count, "{name}: {n}");
            let error = (gradients[n] - length).abs();
            assert!(error < 1e-5, "{name}: {n}: {} {length}", gradients[n]);
        }
        let seen = |count: f32| {
            views
                .iter()
                .zip(1..)
                .any(|(views, n)| *views == n as f32 + count)
        };
        assert!(seen(0.0) && seen(1.0) && seen(2.0), "{views:?}");
    }
}
