//! Renders anything that Gaussians have, in one pass: `rasterize` blends any number of channels.
//! Here colour, depth, and a feature: the position in space, as a colour.
//!
//! The picture, of a held-out view: colour, alpha, depth (near is bright), position.
//! Run it: `cargo run --release --example render_channels [STEPS [FOLDER [CAPTURE]]]`

mod common;

use burn_splat::ops::device::to_host;
use burn_splat::ops::sigmoid;
use burn_splat::prelude::*;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args = common::Arguments::read(2000, "examples/data/saharov")?;
    let device = Device::flex();
    let capture = Capture::load(&args.input, &CaptureSettings::new().with_downscale(2))?;
    let trained = Trainer::builder(capture.clone())
        .settings(TrainSettings::new().with_steps(args.size))
        .device(device.clone())
        .build()?
        .run()?;
    let (model, settings) = (trained.model, trained.render_settings);
    let view = capture.test_views().next().ok_or("no view is held out")?;
    let camera = view.camera().relative_to(model.origin);
    let camera = CameraTensors::from_camera(&camera, &device);

    // The same two steps as in `render`, with more channels than colours between them.
    let projected = project_gaussians(&model, &camera, &settings)?;
    let colors = model.shade(&camera, &projected, &settings)?; // [1, N, 3]
    let depths = projected.depths().unsqueeze_dim(2); // [1, N, 1]
    let (variance, mean) = model.means.val().var_mean(0);
    let positions = sigmoid((model.means.val() - mean) / variance.sqrt()).unsqueeze(); // [1, N, 3]
    let channels = Tensor::cat(vec![colors, depths, positions], 2);
    let opacities = model.opacities();
    let rendered = rasterize(&projected, channels, opacities, None, &settings.rasterize)?;

    let (image, alpha) = (rendered.image(), rendered.alpha());
    let channel = |start, count| image.clone().narrow(3, start, count);
    // Blended depth is weighted by alpha, which is less than one where the background shows.
    let depth = channel(3, 1) / alpha.clone().clamp_min(1e-6);

    let mut sorted = to_host(depth.clone())?;
    sorted.sort_by(f32::total_cmp);
    let [near, middle, far] = [1, 50, 99].map(|percent| sorted[(sorted.len() - 1) * percent / 100]);
    let mean_alpha = alpha.clone().mean().into_scalar::<f32>();
    println!("mean alpha {mean_alpha:.3}, depths {near:.2} to {far:.2}, median {middle:.2}");
    // Logarithms show differences near and far.
    let depth = ((depth.clamp(near, far).log() - far.ln()) / (near / far).ln()).clamp(0.0, 1.0);
    args.save(
        "render_channels",
        &[channel(0, 3), alpha, depth, channel(4, 3)],
    )
}
