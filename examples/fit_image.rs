//! Fits Gaussians to one picture with a loop of one's own: no capture, no trainer, no density
//! control. To run it: `cargo run --release --example fit_image [PICTURE [STEPS]]`

use burn_splat::ops::AdamRows;
use burn_splat::prelude::*;
use glam::DMat4;

const COUNT: usize = 2000;

/// Gaussians on a grid in front of the camera, in grey.
fn start(device: &Device) -> Gaussians {
    let side = (COUNT as f64).sqrt() as usize;
    let at = |i: usize| (i as f32 + 0.5) / side as f32 * 2.0 - 1.0;
    let means: Vec<[f32; 3]> = (0..side * side)
        .map(|i| [at(i % side), at(i / side), 2.0])
        .collect();
    let n = means.len();
    let splats = SplatData {
        means,
        log_scales: vec![[(1.0 / side as f32).ln(); 3]; n],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![0.0; n],
        sh0: vec![[0.0; 3]; n],
        ..SplatData::default()
    };
    Gaussians::from_data(&splats, device)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let capture = Capture::load(
        "examples/data/saharov",
        &CaptureSettings::new().with_downscale(4),
    )?;
    let view = match arguments.next() {
        Some(name) => capture.views.iter().find(|view| view.name == name),
        None => capture.views.first(),
    };
    let view = view.ok_or("the capture has no photo of that name")?;
    let steps = arguments.next().map_or(Ok(300), |steps| steps.parse())?;
    let device = Device::flex().autodiff();
    let (width, height) = (f64::from(view.width), f64::from(view.height));
    // The grid fills the picture.
    let camera = Camera {
        viewmat: DMat4::IDENTITY,
        intrinsics: [width, height, width / 2.0, height / 2.0],
        size: ImageSize {
            width: view.width,
            height: view.height,
        },
    };
    let camera = CameraTensors::from_camera(&camera, &device);
    let photo = burn_splat::train::photo(view, &device);
    let scale = SceneScale::new(2.0).ok_or("a positive size")?;
    let rates = LearningRates::new();
    let mut model = Optimized::with_adam(start(&device), &rates, AdamRows::All, scale)?;
    for step in 0..steps {
        let image = render(model.model(), &camera, &RenderSettings::new())?.image();
        let loss = (image - photo.clone()).square().mean();
        let gradients = model.gradients(&mut loss.backward());
        model.step(gradients, |field| {
            (field.rate_at(step, steps, scale), FieldStep::Step(1.0))
        })?;
        if step % 50 == 0 || step + 1 == steps {
            let psnr = -10.0 * loss.into_scalar::<f32>().log10();
            println!("step {step:4}: {psnr:.2} dB");
        }
    }
    Ok(())
}
