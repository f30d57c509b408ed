//! Compares the photometric loss with the same loss composed of tensor ops, in value and gradient.

use burn::tensor::{DType, Device, Int, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use super::devices;
use crate::{SsimArgs, Target, photometric, ssim_map};

/// B, H, W, D, E: one band and one strip, odd sizes, several of both, and sizes smaller than the
/// window.
const SHAPES: [[usize; 5]; 8] = [
    [1, 24, 32, 3, 4],
    [2, 61, 37, 3, 3],
    [2, 53, 29, 2, 5],
    [1, 110, 530, 1, 2],
    [1, 11, 11, 1, 1],
    [2, 7, 9, 3, 4],
    [1, 60, 5, 3, 4],
    [1, 1, 1, 3, 4],
];
/// Weights of L1 and SSIM in the loss.
const WEIGHTS: [f64; 2] = [0.7, -1.3];

fn args() -> SsimArgs {
    window(5, 1.5)
}

/// A window of 2 `radius` + 1.
fn window(radius: i32, sigma: f64) -> SsimArgs {
    let exponent = |i: i32| -0.5 * (f64::from(i) / sigma).powi(2);
    let weights: Vec<f64> = (-radius..=radius).map(|i| exponent(i).exp()).collect();
    let total: f64 = weights.iter().sum();
    SsimArgs {
        window: weights.iter().map(|weight| weight / total).collect(),
        c1: 1e-4,
        c2: 9e-4,
    }
}

/// Two similar images, equal in a fifth of their values.
struct Pair {
    rendered: TensorData,
    levels: TensorData,
    values: TensorData,
}

fn pair([b, h, w, d, e]: [usize; 5]) -> Pair {
    let mut rng = Pcg32::seed_from_u64(70);
    let levels: Vec<u8> = (0..b * h * w * d).map(|_| rng.random()).collect();
    let values: Vec<f32> = levels
        .iter()
        .map(|level| f32::from(*level) / 255.0)
        .collect();
    let mut rendered = Vec::new();
    for pixel in values.chunks(d) {
        rendered.extend((0..e).map(|channel| {
            let value = pixel.get(channel).copied().unwrap_or(0.5);
            if rng.random_bool(0.2) {
                value
            } else {
                value + rng.random_range(-0.3f32..0.3)
            }
        }));
    }
    Pair {
        rendered: TensorData::new(rendered, [b, h, w, e]),
        levels: TensorData::new(levels, [b, h, w, d]),
        values: TensorData::new(values, [b, h, w, d]),
    }
}

/// L1, SSIM and the gradient of the rendered image.
fn outcome(rendered: Tensor<4>, [l1, ssim]: [Tensor<1>; 2]) -> [Vec<f64>; 3] {
    let loss = l1.clone() * WEIGHTS[0] + ssim.clone() * WEIGHTS[1];
    let gradient = rendered.grad(&loss.backward()).unwrap();
    [l1, ssim]
        .map(|value| value.try_into_vec_as::<f64>().unwrap())
        .into_iter()
        .chain([gradient.try_into_vec_as::<f64>().unwrap()])
        .collect::<Vec<_>>()
        .try_into()
        .unwrap()
}

fn fused(
    data: TensorData,
    target: impl Into<Target>,
    args: &SsimArgs,
    at: (&Device, DType),
) -> [Vec<f64>; 3] {
    let rendered = Tensor::<4>::from_data(data, at).require_grad();
    let measured = photometric(rendered.clone(), target, args).unwrap();
    assert_eq!(measured.losses().dims(), [2]);
    outcome(rendered, [measured.l1(), measured.ssim()])
}

/// The same from slices, maps and means, in double precision.
fn composed(pair: &Pair, args: &SsimArgs) -> [Vec<f64>; 3] {
    let device = Device::flex().autodiff();
    let at = (&device, DType::F64);
    let rendered = Tensor::<4>::from_data(pair.rendered.clone(), at).require_grad();
    let target = Tensor::<4>::from_data(pair.values.clone(), at);
    let [_, h, w, d] = target.dims();
    let image = rendered.clone().narrow(3, 0, d);
    let mut map = ssim_map(image.clone(), target.clone(), args).unwrap();
    let taps = args.window.len();
    if h >= taps && w >= taps {
        let [rows, columns] = [h, w].map(|side| side + 1 - taps);
        map = map.narrow(1, taps / 2, rows).narrow(2, taps / 2, columns);
    }
    outcome(rendered, [(image - target).abs().mean(), map.mean()])
}

fn check(case: &str, found: &[Vec<f64>; 3], expected: &[Vec<f64>; 3], limit: f64) {
    for (name, (found, expected)) in ["l1", "ssim", "gradient"]
        .iter()
        .zip(found.iter().zip(expected))
    {
        assert_eq!(found.len(), expected.len(), "{case}: {name}");
        let square = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>();
        let difference = square(&mut found.iter().zip(expected).map(|(f, e)| f - e));
        let error = (difference / square(&mut expected.iter().copied())).sqrt();
        assert!(error <= limit, "{case}: {name} is off by {error:e}");
    }
}

#[test]
fn one_sweep_gives_what_tensors_give() {
    for shape in SHAPES {
        let pair = pair(shape);
        let expected = composed(&pair, &args());
        let device = Device::flex().autodiff();
        let at = (&device, DType::F64);
        let values = Tensor::<4>::from_data(pair.values.clone(), at);
        let found = fused(pair.rendered.clone(), values, &args(), at);
        check(&format!("double, {shape:?}"), &found, &expected, 1e-9);

        for (name, device) in devices() {
            let device = device.autodiff();
            let at = (&device, DType::F32);
            let values = Tensor::<4>::from_data(pair.values.clone(), at);
            let found = fused(pair.rendered.clone(), values, &args(), at);
            check(&format!("{name}, {shape:?}"), &found, &expected, 1e-5);
            for dtype in [DType::U8, DType::I32] {
                if !device.supports_dtype(dtype) {
                    continue;
                }
                let levels = Tensor::<4, Int>::from_data(pair.levels.clone(), (&device, dtype));
                let found = fused(pair.rendered.clone(), levels, &args(), at);
                let case = format!("{name}, {dtype:?}, {shape:?}");
                check(&case, &found, &expected, 1e-5);
            }
        }
    }
}

/// Includes windows that do not fit into shared memory.
#[test]
fn windows_of_any_length_give_what_tensors_give() {
    for radius in [0, 1, 9, 60] {
        let args = window(radius, 1.5 + f64::from(radius) / 10.0);
        let pair = pair([1, 40, 35, 3, 4]);
        let expected = composed(&pair, &args);
        for (name, device) in devices() {
            let device = device.autodiff();
            let at = (&device, DType::F32);
            let levels = Tensor::<4, Int>::from_data(pair.levels.clone(), (&device, DType::I32));
            let found = fused(pair.rendered.clone(), levels, &args, at);
            // A window of a single value measures no contrast: c2 / c2 up to rounding.
            let limit = if radius == 0 { 1e-4 } else { 1e-5 };
            check(
                &format!("{name}, radius {radius}"),
                &found,
                &expected,
                limit,
            );
        }
    }
}

#[test]
fn nothing_but_the_means_is_made_where_nothing_is_tracked() {
    let pair = pair(SHAPES[3]);
    let expected = composed(&pair, &args());
    let device = Device::flex();
    let rendered = Tensor::<4>::from_data(pair.rendered, (&device, DType::F64));
    let target = Tensor::<4>::from_data(pair.values, (&device, DType::F64));
    let measured = photometric(rendered, target, &args()).unwrap();
    let [l1, ssim] = [measured.l1(), measured.ssim()].map(|value| value.into_scalar::<f64>());
    assert!((l1 - expected[0][0]).abs() < 1e-12 && (ssim - expected[1][0]).abs() < 1e-12);
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let device = Device::flex().autodiff();
    let run = |threads: usize, dtype: DType| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        pool.build().unwrap().install(|| {
            let pair = pair([2, 150, 300, 3, 4]);
            let levels = Tensor::<4, Int>::from_data(pair.levels, (&device, DType::U8));
            fused(pair.rendered, levels, &args(), (&device, dtype))
        })
    };
    let bits = |values: [Vec<f64>; 3]| values.map(|v| v.into_iter().map(f64::to_bits).collect());
    // In single precision, differences in summation order would hardly show.
    for dtype in [DType::F32, DType::F64] {
        let one: [Vec<u64>; 3] = bits(run(1, dtype));
        for threads in [2, 3] {
            assert!(
                one == bits(run(threads, dtype)),
                "{threads} threads, {dtype:?}"
            );
        }
    }
}

#[test]
fn what_does_not_fit_is_refused() {
    let device = Device::flex().autodiff();
    let zeros = |shape: [usize; 4]| Tensor::<4>::zeros(shape, &device);
    let measure = |target: Tensor<4>| photometric(zeros([1, 12, 13, 4]), target, &args());
    assert!(measure(zeros([1, 12, 13, 3])).is_ok());
    for shape in [
        [1, 12, 13, 5],
        [1, 12, 13, 0],
        [1, 13, 12, 3],
        [2, 12, 13, 3],
    ] {
        let error = measure(zeros(shape)).unwrap_err().to_string();
        assert!(error.contains("1 <= D <= E"), "{error}");
    }
    let tracked = zeros([1, 12, 13, 3]).require_grad();
    let error = measure(tracked).unwrap_err().to_string();
    assert!(error.contains("ssim_map"), "{error}");
    let even = SsimArgs {
        window: vec![0.5; 2],
        ..args()
    };
    assert!(photometric(zeros([1, 12, 13, 3]), zeros([1, 12, 13, 3]), &even).is_err());
}

/// Masked pixels affect neither value nor gradient, and a full mask equals no mask.
#[test]
fn a_mask_leaves_pixels_out() {
    for (_, device) in devices() {
        let shape = [2, 24, 32, 3, 4];
        let [b, h, w, ..] = shape;
        let pair = pair(shape);
        let device = device.autodiff();
        let at = (&device, DType::F32);
        let masked = |change: f32, keep: usize| {
            let rendered = Tensor::<4>::from_data(pair.rendered.clone(), at);
            let target = Tensor::<4>::from_data(pair.values.clone(), at).detach();
            let kept = Tensor::<4>::ones([b, keep, w, 1], &device);
            let left_out = Tensor::<4>::zeros([b, h - keep, w, 1], &device);
            let mask = Tensor::cat(vec![kept, left_out.clone()], 1);
            // Masked pixels may hold anything.
            let changed = rendered.clone() + change;
            let left = mask.clone().equal_elem(0.0).repeat_dim(3, 4);
            let rendered = rendered.mask_where(left, changed).detach().require_grad();
            let measured = crate::photometric_masked(rendered.clone(), target, mask, &args());
            let measured = measured.unwrap();
            outcome(rendered, [measured.l1(), measured.ssim()])
        };
        let [plain, other, none] = [0.0, 3.0, f32::NAN].map(|change| masked(change, 10));
        assert_eq!(plain, other);
        assert_eq!(plain[..2], none[..2]);
        let row = w * 4;
        for image in plain[2].chunks(h * row) {
            assert!(image[10 * row..].iter().all(|gradient| *gradient == 0.0));
            assert!(image[..10 * row].iter().any(|gradient| *gradient != 0.0));
        }
        // L1 by hand over the kept pixels.
        let rendered = pair.rendered.clone().try_into_vec::<f32>().unwrap();
        let values = pair.values.clone().try_into_vec::<f32>().unwrap();
        let pixels = (0..b * h * w).filter(|pixel| pixel / w % h < 10);
        let difference = |pixel: usize| -> f64 {
            let of = |d: usize| f64::from((rendered[pixel * 4 + d] - values[pixel * 3 + d]).abs());
            (0..3).map(of).sum()
        };
        let l1 = pixels.map(difference).sum::<f64>() / (b * 10 * w * 3) as f64;
        assert!(
            (plain[0][0] / l1 - 1.0).abs() < 1e-5,
            "{} {l1}",
            plain[0][0]
        );

        let whole = masked(0.0, h);
        let rendered = Tensor::<4>::from_data(pair.rendered.clone(), at).require_grad();
        let target = Tensor::<4>::from_data(pair.values.clone(), at).detach();
        let measured = photometric(rendered.clone(), target, &args()).unwrap();
        let expected = outcome(rendered, [measured.l1(), measured.ssim()]);
        for (whole, expected) in whole.iter().flatten().zip(expected.iter().flatten()) {
            assert!((whole - expected).abs() <= 1e-6 * expected.abs().max(1e-3));
        }
    }
}
