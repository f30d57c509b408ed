//! Checks the gradient of a function of one's own, and finds what is wrong with another. To run it:
//! `cargo run --release --example check_gradient`

use burn_splat::prelude::*;
use splat_lab::central::{gradcheck, tensor};

/// A soft threshold of opacities.
fn threshold(opacity: Tensor<1>, at: Tensor<1>) -> Tensor<1> {
    burn_splat::ops::sigmoid((opacity - at) * 10.0)
}

/// The same, with a gradient that somebody forgot.
fn forgotten(opacity: Tensor<1>, at: Tensor<1>) -> Tensor<1> {
    burn_splat::ops::sigmoid((opacity - at.detach()) * 10.0)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let opacity = || tensor([0.1, 0.35, 0.8], [3]);
    let at = || tensor([0.3], [1]);
    let right = gradcheck(
        |(opacity, at)| threshold(opacity, at),
        (("opacity", opacity()), ("at", at())),
    )?;
    println!("{right}");
    right.check()?;
    let wrong = gradcheck(
        |(opacity, at)| forgotten(opacity, at),
        (("opacity", opacity()), ("at", at())),
    )?;
    println!("{wrong}");
    if wrong.is_ok() {
        return Err("the forgotten gradient was not found".into());
    }
    Ok(())
}
