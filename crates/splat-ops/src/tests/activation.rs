//! Activations and their gradients are accurate at both ends.

use burn::tensor::{Tensor, TensorData};

use super::devices;
use crate::{exp, sigmoid};

/// Compared with double precision at both ends, at the bend, and between. Below a logit of -87 the
/// opacity itself leaves the range of normal floats.
#[test]
fn activations_and_their_gradients_keep_their_digits() {
    let at = [-80.0, -30.0, -5.0, -0.1, 0.0, 0.1, 5.0, 17.0, 30.0, 80.0f32];
    for (name, device) in devices() {
        let device = device.autodiff();
        let x = Tensor::<1>::from_data(TensorData::from(at), &device).require_grad();
        let to_host = |x: Tensor<1>| x.into_data().try_into_vec::<f32>().unwrap();
        let value_and_gradient = |y: Tensor<1>| {
            let gradient = x.grad(&y.clone().sum().backward()).unwrap();
            (to_host(y), to_host(gradient))
        };
        let (opacities, slopes) = value_and_gradient(sigmoid(x.clone()));
        let (scales, same) = value_and_gradient(exp(x.clone()));
        assert_eq!(scales, same);
        for (i, x) in at.into_iter().map(f64::from).enumerate() {
            let error = |got: f32, want: f64| (f64::from(got) / want - 1.0).abs();
            let opacity = 1.0 / (1.0 + (-x).exp());
            let slope = opacity / (1.0 + x.exp());
            let bound = 1e-6;
            assert!(
                error(opacities[i], opacity) < bound,
                "{name}: opacity at {x}"
            );
            assert!(error(slopes[i], slope) < bound, "{name}: slope at {x}");
            assert!(error(scales[i], x.exp()) < bound, "{name}: exp at {x}");
        }
    }
}
