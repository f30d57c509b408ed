//! Checks the gradient of a function of one's own against central differences. It blends samples
//! along rays, front to back; the same with a bug forgets that a sample hides those behind it.
//!
//! The picture, right and wrong: relative errors of the gradient of every opacity, from 1e-16
//! (dark) to 1 (bright). A row is a ray, from the eye on the left. The last sample of a ray hides
//! nothing, so that its gradient is right in both. `burn_splat::lab` is the feature `lab`, which
//! the examples of this repository have.
//!
//! Run it: `cargo run --release --example own_op_gradcheck [SIZE [FOLDER]]`

mod common;

use burn_splat::lab::central::{Comparison, gradcheck, tensor};
use burn_splat::prelude::*;

/// Light `[R, 1]` of R rays, of the opacities and colours `[R, K]` of their samples.
fn blend(opacities: Tensor<2>, colors: Tensor<2>) -> Tensor<2> {
    let transmittance = transmittance(opacities.clone());
    (opacities * transmittance * colors).sum_dim(1)
}

/// The same, with a `detach` too many.
fn blend_wrong(opacities: Tensor<2>, colors: Tensor<2>) -> Tensor<2> {
    let transmittance = transmittance(opacities.clone()).detach();
    (opacities * transmittance * colors).sum_dim(1)
}

/// Share of the light that passes all samples in front of each one.
fn transmittance(opacities: Tensor<2>) -> Tensor<2> {
    let passes = (-opacities + 1.0).log();
    (passes.clone().cumsum(1) - passes).exp()
}

type Function = fn(Tensor<2>, Tensor<2>) -> Tensor<2>;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args = common::Arguments::read(16, "")?;
    let n = args.size;
    let waves = |shift: f64| -> Vec<f64> {
        let wave = |i: usize| 0.4 + 0.3 * (shift + i as f64 * 2.3).sin();
        (0..n * n).map(wave).collect()
    };
    let opacities = || tensor(waves(0.0), [n, n]);
    let colors = || tensor(waves(1.0), [n, n]);

    let mut images = Vec::new();
    for (name, function) in [("right", blend as Function), ("wrong", blend_wrong)] {
        let inputs = (("opacities", opacities()), ("colors", colors()));
        let report = gradcheck(|(opacities, colors)| function(opacities, colors), inputs)?;
        if report.is_ok() != (name == "right") {
            return Err(format!("the verdict on the {name} function is wrong\n{report}").into());
        }
        match report.check() {
            Ok(report) => println!("{name}: errors up to {:.0e}", report.worst_relative()),
            Err(failure) => println!("{name}: {failure}"),
        }

        // One check per element, for the picture: `report` names the worst ones only.
        let mut pixels = Vec::new();
        for (row, column) in (0..n * n).map(|i| (i / n, i % n)) {
            let place = [row..row + 1, column..column + 1];
            let one = opacities().slice(place.clone());
            let with = |one| opacities().slice_assign(place.clone(), one);
            let report = gradcheck(|one| function(with(one), colors()), ("opacity", one))?;
            let worst = report.rows[0].worst.as_ref();
            let error = worst.map_or(0.0, Comparison::relative);
            let heat = (error.max(1e-16).log10() / 16.0 + 1.0) as f32;
            pixels.extend([heat, heat * heat, 0.4 * (1.0 - heat)]);
        }
        let pixels = TensorData::new(pixels, [1, n, n, 3]);
        images.push(Tensor::from_data(pixels, &Device::flex()));
    }
    args.save("own_op_gradcheck", &images)
}
