//! Fits 4,096 Gaussians to one photo: the hello world of splatting, with nothing but Burn and two
//! ops. The model is a plain Burn module, trained by Burn's Adam in a loop of three lines.
//!
//! The picture: before, after, the photo.
//! Run it: `cargo run --release --example fit_image [STEPS [FOLDER [PHOTO]]]`

mod common;

use burn::optim::{AdamConfig, GradientsParams};
use burn_splat::ops::{exp, sigmoid};
use burn_splat::prelude::*;

/// N Gaussians. What must be positive or in (0, 1) is kept before its activation.
#[derive(Module, Debug)]
struct Splats {
    means: Param<Tensor<2>>,      // [N, 3]
    log_scales: Param<Tensor<2>>, // [N, 3]
    quats: Param<Tensor<2>>,      // [N, 4]
    opacities: Param<Tensor<1>>,  // [N], logits
    colors: Param<Tensor<2>>,     // [N, 3], logits
}

impl Splats {
    /// Grey Gaussians on a grid, one unit in front of the camera.
    fn grid(side: usize, device: &Device) -> Self {
        let n = side * side;
        let at = |i: usize| (i as f32 + 0.5) / side as f32 - 0.5;
        let means = (0..n).flat_map(|i| [at(i % side), at(i / side), 1.0]);
        let means = TensorData::new(means.collect::<Vec<_>>(), [n, 3]);
        let log_scale = (0.5 / side as f32).ln();
        let quats = Tensor::<2>::from_floats([[1.0, 0.0, 0.0, 0.0]], device);
        Self {
            means: Param::from_data(means, device),
            log_scales: Param::from_tensor(Tensor::full([n, 3], log_scale, device)),
            quats: Param::from_tensor(quats.repeat_dim(0, n)),
            opacities: Param::from_tensor(Tensor::zeros([n], device)),
            colors: Param::from_tensor(Tensor::zeros([n, 3], device)),
        }
    }

    /// The image `[1, H, W, 3]` in a camera at the origin, which sees the whole grid.
    fn render(&self, size: ImageSize, device: &Device) -> Result<Tensor<4>, OpError> {
        let (w, h) = (size.width as f32, size.height as f32);
        let viewmat = Tensor::<2>::eye(4, device).unsqueeze();
        let intrinsics = Tensor::from_floats([[w, h, w / 2.0, h / 2.0]], device);
        let (means, quats) = (self.means.val(), self.quats.val());
        let (scales, settings) = (exp(self.log_scales.val()), ProjectSettings::default());
        let splats = project(means, quats, scales, viewmat, intrinsics, size, &settings)?;
        let (colors, opacities) = (sigmoid(self.colors.val()), sigmoid(self.opacities.val()));
        let settings = RasterizeSettings::default();
        Ok(rasterize(&splats, colors, opacities, None, &settings)?.image())
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args = common::Arguments::read(1000, "examples/data/saharov/images/IMG_3023.jpg")?;
    let device = Device::flex().autodiff();
    let photo = image::open(&args.input)?.thumbnail(480, 480).to_rgb32f();
    let (width, height) = photo.dimensions();
    let photo = TensorData::new(photo.into_raw(), [1, height as usize, width as usize, 3]);
    let photo = Tensor::<4>::from_data(photo, &device);

    let size = ImageSize { width, height };
    let mut splats = Splats::grid(64, &device);
    let mut adam = AdamConfig::new().with_epsilon(1e-15).init();
    let before = splats.render(size, &device)?;
    for _ in 0..args.size {
        let loss = losses::mse(splats.render(size, &device)?, photo.clone());
        let gradients = GradientsParams::from_grads(loss.backward(), &splats);
        splats = adam.step(5e-3, splats, gradients);
    }
    let after = splats.render(size, &device)?;
    let [start, end] = [&before, &after].map(|image| common::psnr(image, &photo));
    println!(
        "{start:.2} dB before, {end:.2} dB after {} steps",
        args.size
    );
    args.save("fit_image", &[before, after, photo])
}
