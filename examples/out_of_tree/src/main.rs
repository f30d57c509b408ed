//! Everything that one may bring along, in a crate that depends on `burn-splat` alone: a strategy,
//! a loss, a model with a parameter that `Gaussians` does not have, and a module that is trained
//! beside it. `cargo run --release -- [CAPTURE [STEPS]]`

mod exposure;
mod model;
mod prune;

use burn_splat::prelude::*;

use exposure::Exposure;
use model::Tinted;
use prune::PruneAndClone;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let folder = arguments.next().unwrap_or("../data/saharov".into());
    let steps = arguments.next().map_or(Ok(200), |steps| steps.parse())?;
    let capture = Capture::load(folder, &CaptureSettings::new().with_downscale(4))?;
    let device = Device::flex();
    let config = TrainSettings::new().with_steps(steps);
    // A loss is a closure on tensors, or a list of named and weighted ones.
    let loss = LossTerms::l1_ssim(0.2).term("opaque", 0.01, |_, rendered| {
        Ok((-rendered.alpha() + 1.0).mean())
    });
    let trained = Trainer::builder(capture.clone())
        .settings(config)
        .device(device.clone())
        .loss(loss)
        .hook(Exposure::new(capture.split.train.len(), &device)?)
        .model(Tinted::new)
        .strategy(PruneAndClone::default())
        .on_progress(|state| {
            if state.step % 50 == 0 {
                let loss = state.history.mean_loss(50).unwrap_or(f64::NAN);
                println!("step {:4}: loss {loss:.4}, {} Gaussians", state.step, state.gaussians);
            }
        })
        .build()?
        .run()?;

    let views: Vec<_> = capture.test_views().collect();
    let settings = &trained.render_settings;
    let scores = evaluate(&trained.model, &views, settings, &device, |_, _| {})?;
    println!("held out: {:.2} dB", scores.psnr);
    if let Some(exposure) = trained.hook::<Exposure>() {
        println!("exposures: {:.3?}", exposure.gains()?);
    }
    let (first, last) = (&trained.history.losses[0], &trained.history.losses[steps - 1]);
    if last.total < 0.8 * first.total {
        return Ok(());
    }
    Err(format!("the loss went from {} to {}: it did not learn", first.total, last.total).into())
}
