//! The probe receives the gradient of the splats and changes nothing.

use burn::tensor::{Tensor, TensorData};

use super::devices;
use crate::{ImageSize, Projected};

#[test]
fn a_probe_gets_the_gradient_of_the_splats() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let values: Vec<f32> = (0..2 * 5 * 9).map(|i| i as f32).collect();
        let packed = Tensor::<3>::from_data(TensorData::new(values, [2, 5, 9]), &device);
        let packed = packed.require_grad();
        let size = ImageSize {
            width: 8,
            height: 8,
        };
        let projected = Projected::from_packed(packed.clone() * 2.0, size).unwrap();
        let (probed, probe) = projected.clone().with_screen_probe();
        let to_host = |x: Tensor<3>| x.into_data().try_into_vec::<f32>().unwrap();
        assert_eq!(
            to_host(probed.packed()),
            to_host(projected.packed()),
            "{name}"
        );

        let grads = (probed.packed() * packed.clone().detach()).sum().backward();
        let of_probe = to_host(probe.grad(&grads).unwrap());
        let of_packed = to_host(packed.grad(&grads).unwrap());
        let expected: Vec<f32> = (0..2 * 5 * 9).map(|i| i as f32).collect();
        assert_eq!(of_probe, expected, "{name}");
        let expected: Vec<f32> = (0..2 * 5 * 9).map(|i| 2.0 * i as f32).collect();
        assert_eq!(of_packed, expected, "{name}");
    }
}
