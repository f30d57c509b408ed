//! Absolute gradients: the same on every device and from any number of channels, and nothing for
//! those who do not ask.

use burn::tensor::{DType, Device, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::devices;
use crate::{ImageSize, Projected, RasterizeSettings, rasterize};

const SIZE: ImageSize = ImageSize {
    width: 37,
    height: 21,
};

/// Absolute gradients and gradients of 40 splats in two cameras, of this many channels before a
/// background, for a random upstream gradient. `asked`: whether absolute gradients are asked for;
/// `tracked`: whether the splats have a gradient too.
fn gradients(
    (device, dtype): (&Device, DType),
    channels: usize,
    settings: &RasterizeSettings,
    [asked, tracked]: [bool; 2],
) -> [Option<Vec<f64>>; 2] {
    let device = device.clone().autodiff();
    let options = (&device, dtype);
    let mut rng = Pcg32::seed_from_u64(5);
    let mut uniform = |low: f64, high: f64| f64::from(rng.random_range(low..high) as f32);
    let (c, n) = (2, 40);
    let rows = (0..c * n).flat_map(|i| {
        let (x, y) = (uniform(-4.0, 41.0), uniform(-4.0, 25.0));
        let w = [uniform(0.05, 0.4), uniform(-0.2, 0.2), uniform(0.05, 0.4)];
        [x, y, 1.0 + i as f64, w[0], w[1], w[2], 1.0, 60.0, 60.0]
    });
    let rows: Vec<f64> = rows.collect();
    let mut some =
        |length: usize| -> Vec<f64> { (0..length).map(|_| uniform(-1.0, 1.0)).collect() };
    let colors = TensorData::new(some(c * n * channels), [c, n, channels]);
    let background = TensorData::new(some(c * channels), [c, channels]);
    let (h, w) = (SIZE.height as usize, SIZE.width as usize);
    let upstream = TensorData::new(some(c * h * w * (channels + 1)), [c, h, w, channels + 1]);
    // One of them reaches the cap.
    let opacities: Vec<f64> = (0..n).map(|i| if i == 7 { 1.0 } else { 0.3 }).collect();
    let opacities = Tensor::<1>::from_data(TensorData::new(opacities, [n]), options);

    let packed = Tensor::<3>::from_data(TensorData::new(rows, [c, n, 9]), options);
    let packed = if tracked {
        packed.require_grad()
    } else {
        packed
    };
    let splats = Projected::from_packed(packed.clone(), SIZE).unwrap();
    let (splats, leaf) = match asked {
        true => {
            let (probed, leaf) = splats.with_absgrad();
            (probed, Some(leaf))
        }
        false => (splats, None),
    };
    let colors = Tensor::<3>::from_data(colors, options);
    let background = Tensor::<2>::from_data(background, options);
    let rendered = rasterize(&splats, colors, opacities, Some(background), settings).unwrap();
    let upstream = Tensor::<4>::from_data(upstream, options);
    let gradients = (rendered.packed() * upstream).sum().backward();
    let to_host = |gradient: Tensor<3>| {
        gradient
            .into_data()
            .convert::<f64>()
            .try_into_vec()
            .unwrap()
    };
    [
        leaf.and_then(|leaf| leaf.grad(&gradients)).map(to_host),
        packed.grad(&gradients).map(to_host),
    ]
}

fn error(ours: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(ours.len(), expected.len());
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|x| x * x).sum::<f64>().sqrt();
    norm(&mut ours.iter().zip(expected).map(|(a, b)| a - b)) / norm(&mut expected.iter().copied())
}

/// Channels that go in one launch of the kernels and that do not; sums in order and as they come;
/// with and without a gradient of the splats themselves.
#[test]
fn every_device_agrees_with_double_precision_on_any_number_of_channels() {
    let settings = RasterizeSettings::default();
    for channels in [1, 3, 5, 40] {
        let double = (&Device::flex(), DType::F64);
        let [expected, of_splats] = gradients(double, channels, &settings, [true; 2]);
        let expected = expected.unwrap();
        let of_splats = of_splats.unwrap();
        for (name, device) in devices() {
            for deterministic in [true, false] {
                let settings = RasterizeSettings {
                    deterministic,
                    ..settings
                };
                for tracked in [true, false] {
                    let single = (&device, DType::F32);
                    let ours = gradients(single, channels, &settings, [true, tracked]);
                    let [absolute, packed] = ours;
                    let off = error(&absolute.unwrap(), &expected);
                    assert!(off < 1e-5, "{name}, {channels} channels: {off:e}");
                    assert_eq!(packed.is_some(), tracked);
                    if let Some(packed) = packed {
                        let off = error(&packed, &of_splats);
                        assert!(off < 1e-5, "{name}, {channels} channels: {off:e}");
                    }
                }
            }
        }
    }
}

/// The same bits for the splats whether absolute gradients are asked for or not, and these are at
/// least as large as the gradients.
#[test]
fn asking_changes_nothing_else() {
    let settings = RasterizeSettings::default();
    for (name, device) in devices() {
        let single = (&device, DType::F32);
        let [absolute, with] = gradients(single, 3, &settings, [true; 2]);
        let [nothing, without] = gradients(single, 3, &settings, [false, true]);
        assert_eq!(nothing, None, "{name}");
        assert_eq!(with, without, "{name}");
        let (absolute, with) = (absolute.unwrap(), with.unwrap());
        for (absolute, signed) in absolute.chunks(2).zip(with.chunks(9)) {
            for axis in 0..2 {
                let slack = 1.0 + 1e-5;
                assert!(absolute[axis] * slack >= signed[axis].abs(), "{name}");
            }
        }
        assert!(with.iter().any(|gradient| *gradient != 0.0));
    }
}

#[test]
fn two_renders_of_the_same_splats_add_up() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let packed = [[[8.0, 8.0, 1.0, 0.5, 0.1, 0.5, 1.0, 6.0, 6.0]]];
        let packed = Tensor::<3>::from_floats(packed, &device).require_grad();
        let splats = Projected::from_packed(packed, SIZE).unwrap();
        let absolute = |renders: usize| {
            let (splats, leaf) = splats.clone().with_absgrad();
            let colors = Tensor::<2>::ones([1, 1], &device);
            let opacities = Tensor::<1>::full([1], 0.5, &device);
            let settings = RasterizeSettings::default();
            let sums = (0..renders).map(|_| {
                let rendered =
                    rasterize(&splats, colors.clone(), opacities.clone(), None, &settings);
                rendered.unwrap().image().sum()
            });
            let sum = sums.reduce(|a, b| a + b).unwrap();
            let gradient = leaf.grad(&sum.backward()).unwrap().into_data();
            gradient.try_into_vec::<f32>().unwrap()
        };
        let doubled: Vec<f32> = absolute(1).iter().map(|value| 2.0 * value).collect();
        assert!(doubled[0] > 0.1, "{name}");
        assert_eq!(absolute(2), doubled, "{name}");
    }
}
