//! Trains a capture without `Trainer`: Gaussians, an optimiser per field, and a loop of render,
//! loss, backward and step. The place to start when a run needs another order of events.
//!
//! The picture, of a held-out view: before, after, the photo.
//! Run it: `cargo run --release --example own_loop [STEPS [FOLDER [CAPTURE]]]`

mod common;

use burn_splat::ops::device::keep_awake;
use burn_splat::prelude::*;
use burn_splat::train::photo;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args = common::Arguments::read(2000, "examples/data/saharov")?;
    let steps = args.size;
    let device = Device::flex().autodiff();
    let capture = Capture::load(&args.input, &CaptureSettings::new().with_downscale(2))?;
    // The size of the scene is the unit of the means' learning rate, and of the near plane.
    let cameras: Vec<Camera> = capture.views.iter().map(View::camera).collect();
    let points = capture.points.iter();
    let points: Vec<[f64; 3]> = points.map(|point| point.position).collect();
    let scale = SceneScale::of_capture(&cameras, &points);

    // One Gaussian per point, as large as the distance to its neighbours.
    let means: Vec<[f32; 3]> = points.iter().map(|p| p.map(|x| x as f32)).collect();
    let colors: Vec<[u8; 3]> = capture.points.iter().map(|point| point.color).collect();
    let start = InitSettings::new().with_sh_degree(1);
    let gaussians = splats_from_points(&means, &colors, scale, &start)?;
    let gaussians = Gaussians::from_data(&gaussians, &device);
    let rates = LearningRates::new();
    let mut model = Optimized::with_adam(gaussians, &rates, AdamRows::All, scale)?;

    // A view on the device: its camera and its photo.
    let load = |view: &View| -> Result<_, OpError> {
        let camera = CameraTensors::from_camera(&view.camera(), &device);
        Ok((camera, photo(view, &device)?))
    };
    let views: Vec<_> = capture.train_views().map(load).collect::<Result<_, _>>()?;
    let held_out: Vec<_> = capture.test_views().map(load).collect::<Result<_, _>>()?;
    let settings = RenderSettings::new().with_project(scale.project_settings());
    let ssim = losses::SsimSettings::new();

    let before = render(model.model(), &held_out[0].0, &settings)?.image();
    for step in 0..steps {
        keep_awake(&device);
        let (camera, photo) = &views[step % views.len()];
        let image = render(model.model(), camera, &settings)?.image();
        let l1 = losses::l1(image.clone(), photo.clone());
        let dssim = -losses::ssim(image, photo.clone(), &ssim)? + 1.0;
        let mut gradients = (l1 * 0.8 + dssim * 0.2).backward();
        let gradients = model.gradients(&mut gradients);
        model.step(gradients, |field| {
            (field.rate_at(step, steps, scale), FieldStep::Step(1.0))
        })?;
        // Here: density control with `model.edit_rows`, a schedule, a log, other losses, ...
    }

    let mut psnr = 0.0;
    for (camera, photo) in &held_out {
        let image = render(model.model(), camera, &settings)?.image();
        psnr += losses::psnr(image, photo.clone()).into_scalar::<f32>() / held_out.len() as f32;
    }
    println!(
        "{} Gaussians, {steps} steps: held out {psnr:.2} dB",
        means.len()
    );
    let (camera, photo) = &held_out[0];
    let after = render(model.model(), camera, &settings)?.image();
    args.save("own_loop", &[before, after, photo.clone()])
}
