//! Compares the CubeCL kernels, through Burn and its autodiff, with the native path in f32.

use burn::tensor::{Device, DeviceKind, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::{
    AdamRows, AdamStep, ImageSize, OpError, ProjectSettings, Projected, RasterizeSettings,
    SsimArgs, adam_step, gaussian_blur, project, rasterize, spherical_harmonics, ssim_map,
};

/// True if there is a wgpu adapter, a software one included.
pub(crate) fn has_adapter() -> bool {
    use cubecl::device::WgpuDeviceKind::{Cpu, DefaultDevice};
    let opened = [DefaultDevice, Cpu]
        .into_iter()
        .find_map(|kind| cubecl::Device::wgpu(kind).ok());
    splat_test_support::adapter_or_skip(opened.ok_or("neither a GPU nor a software one")).is_some()
}

struct Scene {
    gaussians: usize,
    size: ImageSize,
    values: Vec<(&'static str, Vec<usize>, Vec<f32>)>,
    weights: Vec<f32>,
}

impl Scene {
    fn new(gaussians: usize, size: ImageSize, cameras: usize, scale: f32) -> Self {
        let mut rng = Pcg32::seed_from_u64(7);
        let mut uniform = |len: usize, low: f32, high: f32| -> Vec<f32> {
            (0..len).map(|_| rng.random_range(low..high)).collect()
        };
        let n = gaussians;
        let mut means = uniform(n * 3, -1.5, 1.5);
        for z in means.iter_mut().skip(2).step_by(3) {
            *z += 3.0;
        }
        let mut viewmats = Vec::new();
        let mut intrinsics = Vec::new();
        for c in 0..cameras {
            let (s, k) = (0.1 * c as f32).sin_cos();
            #[rustfmt::skip]
            viewmats.extend([k, 0.0, s, 0.0,  0.0, 1.0, 0.0, 0.1,  -s, 0.0, k, 0.2,  0.0, 0.0, 0.0, 1.0]);
            let focal = 0.9 * size.width as f32;
            intrinsics.extend([
                focal,
                focal,
                0.48 * size.width as f32,
                0.52 * size.height as f32,
            ]);
        }
        let pixels = (size.width * size.height) as usize;
        Self {
            gaussians,
            size,
            values: vec![
                ("means", vec![n, 3], means),
                ("quats", vec![n, 4], uniform(n * 4, -1.0, 1.0)),
                ("scales", vec![n, 3], uniform(n * 3, 0.1 * scale, scale)),
                ("viewmats", vec![cameras, 4, 4], viewmats),
                ("intrinsics", vec![cameras, 4], intrinsics),
                ("coeffs", vec![n, 16, 3], uniform(n * 48, -0.3, 0.3)),
                ("opacities", vec![n], uniform(n, 0.05, 0.95)),
                (
                    "background",
                    vec![cameras, 3],
                    uniform(cameras * 3, 0.0, 1.0),
                ),
            ],
            weights: uniform(cameras * pixels * 4, -1.0, 1.0),
        }
    }

    /// The blurred image and the named gradients of every input.
    fn run(&self, device: &Device, deterministic: bool) -> Vec<(&'static str, Vec<f32>)> {
        fn tensor<const D: usize>(scene: &Scene, which: usize, device: &Device) -> Tensor<D> {
            let (_, shape, values) = &scene.values[which];
            Tensor::from_data(TensorData::new(values.clone(), shape.clone()), device).require_grad()
        }
        let device = device.clone().autodiff();
        let means = tensor::<2>(self, 0, &device);
        let quats = tensor::<2>(self, 1, &device);
        let scales = tensor::<2>(self, 2, &device);
        let viewmats = tensor::<3>(self, 3, &device);
        let intrinsics = tensor::<2>(self, 4, &device);
        let coeffs = tensor::<3>(self, 5, &device);
        let opacities = tensor::<1>(self, 6, &device);
        let background = tensor::<2>(self, 7, &device);

        let cameras = viewmats.dims()[0];
        let projected = project(
            means.clone(),
            quats.clone(),
            scales.clone(),
            viewmats.clone(),
            intrinsics.clone(),
            self.size,
            &ProjectSettings::default(),
        )
        .unwrap();
        let dirs = means
            .clone()
            .unsqueeze::<3>()
            .expand([cameras, self.gaussians, 3]);
        let colors = spherical_harmonics(coeffs.clone(), dirs, 3).unwrap() + 0.5;
        let rendered = rasterize(
            &projected,
            colors,
            opacities.clone(),
            Some(background.clone()),
            &RasterizeSettings {
                deterministic,
                ..RasterizeSettings::default()
            },
        )
        .unwrap();
        let image = gaussian_blur(rendered.packed(), &[0.1, 0.2, 0.4, 0.2, 0.1]).unwrap();
        let weights = Tensor::from_data(
            TensorData::new(self.weights.clone(), image.dims().to_vec()),
            &device,
        );
        let grads = (image.clone() * weights).sum().backward();
        let to_host = |data: TensorData| data.try_to_vec::<f32>().unwrap();
        vec![
            ("image", to_host(image.into_data())),
            ("means", to_host(means.grad(&grads).unwrap().into_data())),
            ("quats", to_host(quats.grad(&grads).unwrap().into_data())),
            ("scales", to_host(scales.grad(&grads).unwrap().into_data())),
            (
                "viewmats",
                to_host(viewmats.grad(&grads).unwrap().into_data()),
            ),
            (
                "intrinsics",
                to_host(intrinsics.grad(&grads).unwrap().into_data()),
            ),
            ("coeffs", to_host(coeffs.grad(&grads).unwrap().into_data())),
            (
                "opacities",
                to_host(opacities.grad(&grads).unwrap().into_data()),
            ),
            (
                "background",
                to_host(background.grad(&grads).unwrap().into_data()),
            ),
        ]
    }
}

/// |a - b| / |b|
fn relative_l2(a: &[f32], b: &[f32]) -> f64 {
    let square = |v: f64| v * v;
    let error: f64 = a.iter().zip(b).map(|(a, b)| square(f64::from(a - b))).sum();
    let norm: f64 = b.iter().map(|b| square(f64::from(*b))).sum();
    assert!(a.len() == b.len() && norm > 0.0);
    (error / norm).sqrt()
}

#[test]
fn kernels_agree_with_the_native_path_in_images_and_all_gradients() {
    if !has_adapter() {
        return;
    }
    let size = ImageSize {
        width: 75,
        height: 50,
    };
    let scene = Scene::new(400, size, 2, 0.15);
    let native = scene.run(&Device::flex(), true);
    for deterministic in [true, false] {
        let kernels = scene.run(&Device::wgpu(DeviceKind::DefaultDevice), deterministic);
        for ((name, kernels), (_, native)) in kernels.iter().zip(&native) {
            let error = relative_l2(kernels, native);
            println!("{name}, deterministic: {deterministic}: relative L2 {error:.1e}");
            // Both are f32: within the 1e-4 that each keeps to float64.
            assert!(error <= 1e-4, "{name}: relative L2 {error:e}");
        }
    }
    // The native path has only one mode.
    assert_eq!(scene.run(&Device::flex(), false), native);
}

/// S, and the gradients of both images under random weights.
fn run_ssim(device: &Device, shape: [usize; 4], args: &SsimArgs) -> Vec<Vec<f32>> {
    let device = device.clone().autodiff();
    let mut rng = Pcg32::seed_from_u64(11);
    let mut image = || {
        let len = shape.iter().product::<usize>();
        let values: Vec<f32> = (0..len).map(|_| rng.random_range(0.0..1.0)).collect();
        Tensor::<4>::from_data(TensorData::new(values, shape), &device)
    };
    let [x, y, weights] = [image().require_grad(), image().require_grad(), image()];
    let map = ssim_map(x.clone(), y.clone(), args).unwrap();
    let grads = (map.clone() * weights).sum().backward();
    [map, x.grad(&grads).unwrap(), y.grad(&grads).unwrap()]
        .map(|tensor| tensor.into_data().try_to_vec::<f32>().unwrap())
        .into()
}

#[test]
fn structural_similarity_and_its_gradients_are_those_of_the_native_path() {
    if !has_adapter() {
        return;
    }
    // Windows with unrolled loops, one without, and images smaller than the window.
    for (shape, taps) in [
        ([2, 19, 23, 3], 11),
        ([1, 5, 40, 1], 11),
        ([1, 1, 1, 2], 3),
        ([1, 33, 17, 4], 1),
        ([1, 20, 21, 2], 25),
    ] {
        let weights: Vec<f64> = (0..taps)
            .map(|k| (-(k as f64 - (taps / 2) as f64).powi(2) / 4.5).exp())
            .collect();
        let total: f64 = weights.iter().sum();
        let args = SsimArgs {
            window: weights.iter().map(|weight| weight / total).collect(),
            c1: 1e-4,
            c2: 9e-4,
        };
        let native = run_ssim(&Device::flex(), shape, &args);
        let kernels = run_ssim(&Device::wgpu(DeviceKind::DefaultDevice), shape, &args);
        for (what, (kernels, native)) in ["map", "x", "y"].iter().zip(kernels.iter().zip(&native)) {
            let error = relative_l2(kernels, native);
            println!("{shape:?}, {taps} taps, {what}: relative L2 {error:.1e}");
            // A window of a single value measures no contrast: c2 / c2 up to rounding, and no
            // gradient through it.
            let limit = if taps == 1 { 1e-4 } else { 1e-5 };
            assert!(error <= limit, "{shape:?}, {taps} taps, {what}: {error:e}");
        }
    }
}

/// Three steps of Adam. The second has a NaN in its gradient, the third a value too large to
/// square. Some rows have no gradient, one only NaN, one only infinity. The inputs of the first
/// step are `held` or given away.
fn run_adam(device: &Device, rows: AdamRows, held: bool) -> Vec<f32> {
    let mut rng = Pcg32::seed_from_u64(12);
    let mut values = |low: f32, high: f32| {
        let values: Vec<f32> = (0..1001).map(|_| rng.random_range(low..high)).collect();
        values
    };
    let mut gradients = [values(-1.0, 1.0), values(-1e-6, 1e-6), values(-1e3, 1e3)];
    for gradient in &mut gradients {
        gradient[13 * 20..13 * 30].fill(0.0);
        gradient[13 * 22 + 4] = f32::NAN;
        gradient[13 * 27 + 12] = f32::INFINITY;
    }
    gradients[1][5] = f32::NAN;
    gradients[2][7] = 1e30;
    let tensor =
        |values: Vec<f32>| Tensor::<2>::from_data(TensorData::new(values, [77, 13]), device);
    let mut param = tensor(values(-1.0, 1.0));
    let mut moments = [param.zeros_like(), param.zeros_like()];
    let step = AdamStep {
        beta_1: 0.9,
        beta_2: 0.999,
        rate: 1e-3,
        epsilon: 1e-15,
        rows,
    };
    let start = held.then(|| (param.clone(), moments.clone()));
    let values_of = |tensor: &Tensor<2>| tensor.to_data().try_to_vec::<f32>().unwrap();
    let first = values_of(&param);
    for gradient in gradients {
        (param, moments) = adam_step(param, tensor(gradient), moments, &step).unwrap();
    }
    if let Some((param, [moment_1, moment_2])) = start {
        assert_eq!(values_of(&param), first);
        assert_eq!(values_of(&moment_1), [0.0; 1001]);
        assert_eq!(values_of(&moment_2), [0.0; 1001]);
    }
    let [moment_1, moment_2] = moments;
    [param, moment_1, moment_2]
        .iter()
        .flat_map(values_of)
        .collect()
}

#[test]
fn a_step_of_adam_is_that_of_the_native_path() {
    if !has_adapter() {
        return;
    }
    for rows in [AdamRows::All, AdamRows::Seen] {
        let native = run_adam(&Device::flex(), rows, false);
        let wgpu = Device::wgpu(DeviceKind::DefaultDevice);
        let kernel = run_adam(&wgpu, rows, false);
        assert_eq!(kernel, run_adam(&wgpu, rows, true), "{rows:?}");
        for (i, (kernel, native)) in kernel.iter().zip(&native).enumerate() {
            let error = (kernel - native).abs() / native.abs().max(1e-30);
            assert!(error <= 1e-6, "{rows:?}, value {i}: {kernel} and {native}");
        }
    }
}

/// Distance of two positive floats in units in the last place.
fn ulps(a: f32, b: f32) -> u32 {
    a.to_bits().abs_diff(b.to_bits())
}

#[test]
fn the_exponential_is_that_of_the_native_path() {
    use crate::cpu::real::exp2_neg_of_one;
    use cubecl::device::WgpuDeviceKind::{Cpu, DefaultDevice};
    let mut devices = [DefaultDevice, Cpu]
        .into_iter()
        .filter_map(|kind| cubecl::Device::wgpu(kind).ok());
    let Some(device) = devices.next().filter(|_| has_adapter()) else {
        return;
    };
    let client = device.client();
    let values: Vec<f32> = (0..=2_400_000).map(|i| i as f32 * 1e-5).collect();
    let input = splat_kernels::Buffer::from_f32(&client, &values);
    let kernel = splat_kernels::exp::exp2_neg_each(&client, &input)
        .read_f32(&client)
        .unwrap();
    let compare = |native: fn(f32) -> f32| {
        let pairs = values.iter().zip(&kernel);
        let distances = pairs.map(|(t, kernel)| ulps(native(*t), *kernel));
        let (mut worst, mut different) = (0, 0);
        for distance in distances {
            worst = worst.max(distance);
            different += u32::from(distance > 0);
        }
        (worst, different)
    };
    let fused = compare(exp2_neg_of_one::<true>);
    let plain = compare(exp2_neg_of_one::<false>);
    println!("(worst distance in ulp, values that differ): fused {fused:?}, plain {plain:?}");
    // WGSL lets the device choose whether fma rounds once or twice, but not mix the two.
    assert!(
        fused.0 == 0 || plain.0 == 0,
        "fused {fused:?}, plain {plain:?}"
    );
    assert!(fused.0.max(plain.0) <= 1);
    let worst = values
        .iter()
        .zip(&kernel)
        .fold(0.0f64, |worst, (t, kernel)| {
            worst.max((f64::from(*kernel) / (-f64::from(*t)).exp2() - 1.0).abs())
        });
    assert!(worst < 2.5e-7, "relative error {worst:e}");
}

#[test]
fn too_many_pairs_are_an_error_of_the_op_and_not_a_panic() {
    if !has_adapter() {
        return;
    }
    // 12,000 splats over each of 4096 x 4 tiles: more than the 195 million intersections that can
    // be listed.
    let n = 12_000;
    let size = ImageSize {
        width: 65_536,
        height: 64,
    };
    let device = Device::wgpu(DeviceKind::DefaultDevice).autodiff();
    let full = |values: &[f32]| {
        let data = TensorData::new(values.repeat(n), [n, values.len()]);
        Tensor::<2>::from_data(data, &device)
    };
    let projected = project(
        full(&[0.0, 0.0, 1.0]),
        full(&[1.0, 0.0, 0.0, 0.0]),
        full(&[1.0, 1.0, 1.0]),
        Tensor::<2>::eye(4, &device).unsqueeze::<3>(),
        Tensor::<2>::from_data([[1e7, 1e7, 32_768.0, 32.0]], &device),
        size,
        &ProjectSettings::default(),
    )
    .unwrap();
    let colors = full(&[1.0]).require_grad();
    let opacities = full(&[0.5]).squeeze_dim::<1>(1);
    let settings = RasterizeSettings::default();
    let error = rasterize(&projected, colors, opacities, None, &settings).unwrap_err();
    println!("{error}");
    let intersections = n as u64 * 4096 * 4;
    assert!(
        matches!(error, OpError::TooManyIntersections { intersections: found, .. } if found == intersections),
        "{error:?}"
    );
}

/// A wgpu device with only as many `max_storage_buffers_per_shader_stage` as WebGPU guarantees.
fn device_with_webgpu_bindings() -> Option<Device> {
    use cubecl::wgpu::WgpuSetup;
    use cubecl::wgpu::wgpu::{DeviceDescriptor, Instance, Limits, RequestAdapterOptions};
    let instance = Instance::default();
    let adapter = instance.request_adapter(&RequestAdapterOptions::default());
    let adapter = cubecl::future::block_on(adapter).ok()?;
    let limits = Limits {
        max_storage_buffers_per_shader_stage: 8,
        ..adapter.limits()
    };
    let request = adapter.request_device(&DeviceDescriptor {
        required_limits: limits,
        ..DeviceDescriptor::default()
    });
    let (device, queue) = cubecl::future::block_on(request).ok()?;
    let backend = adapter.get_info().backend;
    let setup = WgpuSetup {
        instance,
        adapter,
        device,
        queue,
        backend,
    };
    Device::wgpu_options().setup(setup).init().ok()
}

#[test]
fn too_few_bindings_of_a_device_are_an_error_that_names_the_limit() {
    if !has_adapter() {
        return;
    }
    let device = device_with_webgpu_bindings().expect("a poorer device of the same adapter");
    let row = |values: &[f32]| {
        let data = TensorData::new(values.to_vec(), [1, values.len()]);
        Tensor::<2>::from_data(data, &device)
    };
    let size = ImageSize {
        width: 8,
        height: 8,
    };
    let packed = row(&[4.0, 4.0, 1.0, 0.5, 0.0, 0.5, 1.0, 8.0, 8.0]);
    let projected = Projected::from_packed(packed.unsqueeze(), size).unwrap();
    let (color, opacity) = (row(&[1.0]), row(&[0.5]).squeeze_dim::<1>(1));
    let settings = RasterizeSettings::default();
    let error = rasterize(&projected, color, opacity, None, &settings).unwrap_err();
    println!("{error}");
    let expected = OpError::TooFewBindings {
        op: "rasterize",
        bound: 7,
        needed: splat_kernels::MOST_BUFFERS,
    };
    assert_eq!(error, expected);
    assert!(
        error
            .to_string()
            .contains("max_storage_buffers_per_shader_stage")
    );
}

/// Prints times; run it by name with `--ignored --nocapture`.
#[test]
#[ignore = "a measurement, not a check"]
fn time_of_a_step_at_270_by_480() {
    if !has_adapter() {
        return;
    }
    let size = ImageSize {
        width: 270,
        height: 480,
    };
    let scene = Scene::new(15_000, size, 1, 0.03);
    for (name, device) in [
        ("Flex", Device::flex()),
        ("wgpu", Device::wgpu(DeviceKind::DefaultDevice)),
    ] {
        for round in 0..4 {
            let start = std::time::Instant::now();
            scene.run(&device, true);
            println!("{name}, round {round}: {:?}", start.elapsed());
        }
    }
}
