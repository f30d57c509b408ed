//! Gradient fixtures: safetensors with a scene, its images and its gradients.

use std::path::Path;

use burn::tensor::Device;
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use safetensors::Dtype;
use serde_json::json;
use splat_lab::gradcheck::FIXTURE_KEYS as KEYS;
use splat_lab::gradcheck::{Fixture, Precision, check};

use super::{Follow, Input, Target, per_byte, safetensors as file};
use crate::mutate::{WORDS, number, one_of, real};

pub(super) const TARGET: Target = Target {
    name: "fixture",
    file: "fixture.safetensors",
    seeds,
    mutate,
    parse,
    follow_every: 32,
    memory: per_byte(16),
};

const VALUES: [&str; 9] = [
    "0",
    "1",
    "2",
    "3",
    "0.5",
    "1e-9",
    "pinhole",
    "opencv",
    "opencv_fisheye",
];

fn seeds() -> Vec<Input> {
    let one = fixture(2, None, false, Dtype::F64, &[]);
    let two = fixture(
        3,
        Some(2),
        true,
        Dtype::F32,
        &[("antialias", "1"), ("sh_degree", "2"), ("hard", "1")],
    );
    let none = fixture(
        0,
        None,
        false,
        Dtype::F64,
        &[("camera_model", "pinhole"), ("near", "0.1")],
    );
    vec![one, two, none]
}

/// N Gaussians in front of one camera, or of C, and an image of 5 x 4 pixels. The gradients are
/// arbitrary.
fn fixture(
    n: usize,
    c: Option<usize>,
    depth: bool,
    dtype: Dtype,
    metadata: &[(&str, &str)],
) -> Input {
    let with = |tail: &[usize]| {
        c.into_iter()
            .chain(tail.iter().copied())
            .collect::<Vec<_>>()
    };
    let inputs = [
        ("means", vec![n, 3]),
        ("quats", vec![n, 4]),
        ("scales", vec![n, 3]),
        ("opacities", vec![n]),
        ("sh_coeffs", vec![n, 16, 3]),
        ("viewmat", with(&[4, 4])),
        ("intrinsics", with(&[4])),
        ("background", vec![3]),
    ];
    let mut pictures = vec![("image", with(&[4, 5, 3])), ("alpha", with(&[4, 5, 1]))];
    if depth {
        pictures.push(("depth", with(&[4, 5, 1])));
    }
    let mut tensors = vec![];
    let mut push = |name: String, shape: &[usize], value: &dyn Fn(usize) -> f64| {
        let values = (0..shape.iter().product()).map(value);
        let data: Vec<u8> = match dtype {
            Dtype::F32 => values.flat_map(|x| (x as f32).to_le_bytes()).collect(),
            _ => values.flat_map(f64::to_le_bytes).collect(),
        };
        tensors.push((name, dtype, shape.to_vec(), data));
    };
    let wave = |i: usize| (i as f64 * 0.7).sin() * 0.5;
    for (name, shape) in &inputs {
        let value = |i: usize| match *name {
            "means" if i % 3 == 2 => 3.0 + i as f64,
            "scales" | "opacities" => 0.3 + 0.2 * wave(i),
            "viewmat" => f64::from(u8::from((i % 16).is_multiple_of(5))),
            "intrinsics" => [5.0, 6.0, 2.5, 2.0][i % 4],
            _ => wave(i),
        };
        push((*name).to_owned(), shape, &value);
        push(format!("grad.{name}"), shape, &wave);
    }
    for (name, shape) in &pictures {
        push((*name).to_owned(), shape, &|i| 0.5 + wave(i));
        push(format!("grad_{name}"), shape, &wave);
    }
    Input(vec![file::written(&tensors, metadata)])
}

fn mutate(input: &mut Input, rng: &mut Pcg64Mcg) {
    let bytes = &mut input.0[0];
    let parts = file::parts(bytes).filter(|(header, _)| header.is_object());
    let (Some((mut header, data)), true) = (parts, rng.random_bool(0.3)) else {
        file::mutate(bytes, rng);
        return;
    };
    if !header["__metadata__"].is_object() {
        header["__metadata__"] = json!({});
    }
    let value = match rng.random_range(0..4) {
        0 => number(rng).to_string(),
        1 => real(rng).to_string(),
        2 => (*one_of(rng, &WORDS)).to_owned(),
        _ => (*one_of(rng, &VALUES)).to_owned(),
    };
    header["__metadata__"][*one_of(rng, &KEYS)] = json!(value);
    *bytes = file::joined(&header, &data);
}

/// Reads a fixture; an accepted one is checked if it is small.
fn parse(input: &Input) -> Result<Follow, String> {
    let fixture = Fixture::parse(Path::new("fixture.safetensors"), &input.0[0]);
    let fixture = fixture.map_err(|error| error.to_string())?;
    Ok(Box::new(move || {
        let scene = &fixture.scene;
        let pixels = u64::from(scene.size.width) * u64::from(scene.size.height);
        let small = scene.gaussians <= 8 && scene.cameras <= 4 && pixels <= 1_024;
        small && check(&fixture, &Device::flex(), Precision::F32, None).is_ok()
    }))
}
