//! Gaussians in Burn's file format.

use std::path::Path;

use burn::tensor::Device;
use rand_pcg::Pcg64Mcg;
use splat_model::Gaussians;

use super::ply::{renders, scene};
use super::{Follow, Input, Memory, Target};
use crate::mutate;

pub(super) const TARGET: Target = Target {
    name: "gaussians",
    file: "gaussians.bpk",
    seeds,
    mutate,
    parse,
    follow_every: 64,
    // The library allocates up to a MiB of entries announced by a header before it notices that the
    // file ends.
    memory: Memory {
        per_byte: 32,
        constant: (2 << 20) + (8 << 10),
    },
};

fn seeds() -> Vec<Input> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let file = folder.path().join("gaussians.bpk");
    let mut far = scene(2, 1);
    far.origin = [1e6, -2.5, 3e5];
    let seeds = [scene(3, 0), far, scene(1, 3), scene(0, 2)];
    let written = seeds.iter().map(|seed| {
        let gaussians = Gaussians::from_data(seed, &Device::flex());
        gaussians.save(&file).expect("a writable folder");
        Input(vec![std::fs::read(&file).expect("the file just written")])
    });
    written.collect()
}

fn mutate(input: &mut Input, rng: &mut Pcg64Mcg) {
    mutate::bytes(&mut input.0[0], rng);
}

/// Reads a model; an accepted one is rendered.
fn parse(input: &Input) -> Result<Follow, String> {
    let path = Path::new("gaussians.bpk");
    let gaussians = Gaussians::parse(path, input.0[0].clone(), &Device::flex());
    let gaussians = gaussians.map_err(|error| error.to_string())?;
    Ok(Box::new(move || {
        gaussians.len() <= 100 && renders(&gaussians)
    }))
}
