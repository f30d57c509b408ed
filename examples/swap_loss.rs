//! Swaps the loss of a training run: Charbonnier plus differences of edges, instead of the L1 and
//! SSIM of 3DGS. A loss is a closure on tensors, or a list of named and weighted ones.
//!
//! The picture, of a held-out view: loss of 3DGS, own loss, the photo.
//! Run it: `cargo run --release --example swap_loss [STEPS [FOLDER [CAPTURE]]]`

mod common;

use std::error::Error;

use burn_splat::prelude::*;

/// `mean sqrt(difference^2 + eps^2)`: L1 with a round bottom.
fn charbonnier(difference: Tensor<4>) -> Tensor<1> {
    (difference.square() + 1e-6).sqrt().mean()
}

/// Differences of neighbouring pixels along an axis of `[1, H, W, 3]`.
fn edges(image: Tensor<4>, axis: usize) -> Tensor<4> {
    let length = image.dims()[axis] - 1;
    image.clone().narrow(axis, 1, length) - image.narrow(axis, 0, length)
}

fn own_loss() -> LossTerms {
    LossTerms::new()
        .term("charbonnier", 0.8, |view, rendered| {
            Ok(charbonnier(rendered.image() - view.image()))
        })
        .term("edges", 0.2, |view, rendered| {
            let along = |axis| edges(rendered.image(), axis) - edges(view.image(), axis);
            Ok(charbonnier(along(1)) + charbonnier(along(2)))
        })
}

fn main() -> Result<(), Box<dyn Error>> {
    let args = common::Arguments::read(1000, "examples/data/saharov")?;
    let capture = Capture::load(&args.input, &CaptureSettings::new().with_downscale(2))?;
    let views: Vec<&View> = capture.test_views().collect();
    let train = |name: &str, loss: LossTerms| -> Result<[Tensor<4>; 2], Box<dyn Error>> {
        let trained = Trainer::builder(capture.clone())
            .settings(TrainSettings::new().with_steps(args.size))
            .device(Device::flex())
            .loss(loss)
            .build()?
            .run()?;
        let scores = trained.evaluate(&views, &Device::flex(), |_, _| {})?;
        println!(
            "{name} loss: held out {:.2} dB, SSIM {:.4}",
            scores.psnr, scores.ssim
        );
        common::held_out(&capture, &trained)
    };
    let [_, usual] = train("3DGS", LossTerms::l1_ssim(0.2))?;
    let [photo, own] = train("own", own_loss())?;
    args.save("swap_loss", &[usual, own, photo])
}
