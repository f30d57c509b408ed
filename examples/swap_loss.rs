//! Swaps the loss: Charbonnier plus the edges' differences instead of L1 + D-SSIM. To run it:
//! `cargo run --release --example swap_loss [CAPTURE [STEPS]]`

use burn_splat::prelude::*;

/// `mean sqrt(difference^2 + eps^2)`: L1 with a round bottom.
fn charbonnier(difference: Tensor<4>) -> Tensor<1> {
    (difference.square() + 1e-6).sqrt().mean()
}

/// Differences of neighbouring pixels along an axis of `[B, H, W, D]`.
fn edges(image: Tensor<4>, axis: usize) -> Tensor<4> {
    let length = image.dims()[axis] - 1;
    image.clone().narrow(axis, 1, length) - image.narrow(axis, 0, length)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let folder = arguments.next().unwrap_or("examples/data/saharov".into());
    let steps = arguments.next().map_or(Ok(300), |steps| steps.parse())?;
    let capture = Capture::load(folder, &CaptureSettings::new().with_downscale(2))?;
    let config = TrainSettings::new().with_steps(steps);
    let loss = LossTerms::new()
        .term("charbonnier", 0.8, |view, rendered| {
            Ok(charbonnier(rendered.image() - view.image()))
        })
        .term("edges", 0.2, |view, rendered| {
            let along = |axis| edges(rendered.image(), axis) - edges(view.image(), axis);
            Ok(charbonnier(along(1)) + charbonnier(along(2)))
        });
    let trained = Trainer::builder(capture.clone())
        .settings(config)
        .device(Device::flex())
        .loss(loss)
        .on_progress(|p| match p.history.losses.last() {
            Some(l) if p.step % 50 == 0 => {
                println!("{:5} {:?} {:?}", p.step, p.history.terms, l.terms)
            }
            _ => {}
        })
        .build()?
        .run()?;
    let views: Vec<_> = capture.test_views().collect();
    let scores = evaluate(
        &trained.model,
        &views,
        &trained.render_settings,
        &Device::flex(),
        |_, _| {},
    )?;
    println!("held out: {:.2} dB, SSIM {:.4}", scores.psnr, scores.ssim);
    Ok(())
}
