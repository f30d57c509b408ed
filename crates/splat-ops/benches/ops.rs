//! Times the ops of a training step with their gradients, one by one, on the CPU and on the default
//! wgpu adapter: `cargo bench -p splat-ops --bench ops`.

use burn::tensor::{DType, Device, Int, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;
use splat_ops::device::{kernel_work, reads_half};
use splat_ops::{
    ImageSize, ProjectSettings, Projected, RasterizeSettings, ScreenStatistics, SsimArgs, exp,
    photometric, project, rasterize, sh_colors, sigmoid,
};

fn main() {
    time_of_the_ops_beside_project_and_rasterize();
    time_of_rasterize_by_channels();
}

fn devices() -> Vec<(&'static str, Device)> {
    let mut devices = vec![("Flex", Device::flex())];
    match Device::wgpu_options().init() {
        Ok(device) => devices.push(("wgpu", device)),
        Err(error) => eprintln!("no wgpu adapter is measured: {error}"),
    }
    devices
}

const ROUNDS: u32 = 10;

/// Processor time of this process over all threads, in seconds; zero if the system does not report
/// it.
fn user_time() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields = stat.rsplit(')').next().unwrap_or_default();
    let ticks = fields.split_whitespace().nth(11);
    ticks
        .and_then(|ticks| ticks.parse::<f64>().ok())
        .unwrap_or(0.0)
        / 100.0
}

fn measure(name: &str, device: &Device, mut run: impl FnMut()) {
    // The first rounds include compilation.
    run();
    run();
    device.sync().unwrap();
    let (before, user, start) = (kernel_work(), user_time(), std::time::Instant::now());
    for _ in 0..ROUNDS {
        run();
    }
    device.sync().unwrap();
    let each = f64::from(ROUNDS);
    println!(
        "{name:34} {:8.2} ms, user {:8.2} ms, launches of splat-kernels {}",
        1e3 * start.elapsed().as_secs_f64() / each,
        1e3 * (user_time() - user) / each,
        kernel_work().since(before).launches / u64::from(ROUNDS)
    );
}

struct Random(Pcg32);

impl Random {
    fn data<const D: usize>(&mut self, shape: [usize; D], low: f32, high: f32) -> TensorData {
        let len = shape.iter().product();
        let values: Vec<f32> = (0..len).map(|_| self.0.random_range(low..high)).collect();
        TensorData::new(values, shape)
    }

    fn leaf<const D: usize>(&mut self, shape: [usize; D], device: &Device) -> Tensor<D> {
        Tensor::from_data(self.data(shape, -1.0, 1.0), device).require_grad()
    }
}

fn time_of_the_ops_beside_project_and_rasterize() {
    let n = 100_000;
    let [h, w] = [480, 270];
    for (name, device) in devices() {
        let device = device.autodiff();
        let mut random = Random(Pcg32::seed_from_u64(90));
        let sh0 = random.leaf([n, 1, 3], &device);
        let rest = random.leaf([n, 15, 3], &device);
        let means = random.leaf([n, 3], &device);
        let centers = Tensor::<2>::from_data(random.data([1, 3], -1.0, 1.0), &device);
        for centers in [centers.clone(), centers.clone().require_grad()] {
            let posed = if centers.is_require_grad() {
                ", centres"
            } else {
                ""
            };
            measure(
                &format!("{name}: sh_colors, degree 3{posed}"),
                &device,
                || {
                    let rest = Some(rest.clone());
                    let colors =
                        sh_colors(sh0.clone(), rest, means.clone(), centers.clone(), 3, None)
                            .unwrap();
                    let grads = colors.sum().backward();
                    assert!(means.grad(&grads).is_some());
                },
            );
        }

        let plain = device.clone().inner();
        let constant = |tensor: &Tensor<3>| tensor.clone().inner();
        let mut stored = vec![("", constant(&rest))];
        if reads_half(&plain) {
            stored.push((", halves", constant(&rest).cast(DType::F16)));
        }
        for (precision, rest) in stored {
            measure(
                &format!("{name}: sh_colors, rendering{precision}"),
                &device,
                || {
                    let (sh0, means) = (constant(&sh0), means.clone().inner());
                    let rest = Some(rest.clone());
                    sh_colors(sh0, rest, means, centers.clone().inner(), 3, None).unwrap();
                },
            );
        }

        let scales = random.leaf([n, 3], &device);
        let logits = random.leaf([n], &device);
        measure(&format!("{name}: exp and sigmoid"), &device, || {
            let sum = exp(scales.clone()).sum() + sigmoid(logits.clone()).sum();
            assert!(scales.grad(&sum.backward()).is_some());
        });

        let rendered = random.leaf([1, h, w, 4], &device);
        let dtype = match device.supports_dtype(DType::U8) {
            true => DType::U8,
            false => DType::I32,
        };
        let levels: Vec<u8> = (0..h * w * 3).map(|_| random.0.random()).collect();
        let levels = TensorData::new(levels, [1, h, w, 3]);
        let levels = Tensor::<4, Int>::from_data(levels, (&device, dtype));
        let weights: Vec<f64> = (-5..=5).map(|i| (-f64::from(i * i) / 4.5).exp()).collect();
        let total: f64 = weights.iter().sum();
        let args = SsimArgs {
            window: weights.iter().map(|weight| weight / total).collect(),
            c1: 1e-4,
            c2: 9e-4,
        };
        measure(&format!("{name}: photometric"), &device, || {
            let measured = photometric(rendered.clone(), levels.clone(), &args).unwrap();
            let grads = measured.losses().sum().backward();
            assert!(rendered.grad(&grads).is_some());
        });

        let packed = Tensor::<3>::from_data(random.data([1, n, 9], -1.0, 1.0), &plain);
        let size = ImageSize {
            width: w as u32,
            height: h as u32,
        };
        let projected = Projected::from_packed(packed.clone(), size).unwrap();
        let start = Tensor::<1>::zeros([n], &plain);
        let mut sums = Some(ScreenStatistics {
            gradients: start.clone(),
            views: start,
        });
        measure(&format!("{name}: screen statistics"), &device, || {
            sums = sums
                .take()
                .map(|sums| sums.add(packed.clone(), &projected).unwrap());
        });
    }
}

fn time_of_rasterize_by_channels() {
    let n = 15_000;
    let size = ImageSize {
        width: 270,
        height: 480,
    };
    for (name, device) in devices() {
        let device = device.autodiff();
        let mut random = Random(Pcg32::seed_from_u64(91));
        let mut means = random
            .data([n, 3], -1.5, 1.5)
            .try_into_vec::<f32>()
            .unwrap();
        for z in means.iter_mut().skip(2).step_by(3) {
            *z += 3.0;
        }
        let means = Tensor::<2>::from_data(TensorData::new(means, [n, 3]), &device);
        let quats = Tensor::<2>::from_data(random.data([n, 4], -1.0, 1.0), &device);
        let scales = Tensor::<2>::from_data(random.data([n, 3], 0.003, 0.03), &device);
        let opacities = Tensor::<1>::from_data(random.data([n], 0.05, 0.95), &device);
        let projected = project(
            means,
            quats,
            scales,
            Tensor::<2>::eye(4, &device).unsqueeze::<3>(),
            Tensor::<2>::from_data([[243.0, 243.0, 135.0, 240.0]], &device),
            size,
            &ProjectSettings::default(),
        )
        .unwrap();
        let opacities = opacities.require_grad();
        for channels in [3, 5, 8, 16, 32, 48] {
            let colors = random.leaf([1, n, channels], &device);
            measure(
                &format!("{name}: rasterize, D = {channels}"),
                &device,
                || {
                    let rendered = rasterize(
                        &projected,
                        colors.clone(),
                        opacities.clone(),
                        None,
                        &RasterizeSettings::default(),
                    )
                    .unwrap();
                    let grads = rendered.packed().sum().backward();
                    assert!(colors.grad(&grads).is_some());
                },
            );
        }
    }
}
