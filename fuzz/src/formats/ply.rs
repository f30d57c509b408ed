//! Scenes as PLY: a text header, and rows of text or numbers.

use std::path::Path;

use burn::tensor::Device;
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use splat_data::SplatData;
use splat_data::scene::ply;
use splat_model::{CameraTensors, Gaussians, RenderSettings, render};

use super::{Follow, Input, Memory, Target, capture};
use crate::mutate;

pub(super) const TARGET: Target = Target {
    name: "ply",
    file: "scene.ply",
    seeds,
    mutate,
    parse,
    follow_every: 64,
    // The PLY library allocates up to 65,536 entries of a list, 8 bytes each, before it notices
    // that the file ends.
    memory: Memory {
        per_byte: 32,
        constant: 8 * 65_536 + (8 << 10),
    },
};

const WORDS: [&str; 22] = [
    "ply",
    "format ascii 1.0",
    "format binary_little_endian 1.0",
    "format binary_big_endian 1.0",
    "comment",
    "comment origin 1 2 3",
    "comment origin nan 0 0",
    "comment origin is where it began",
    "obj_info",
    "element vertex 0",
    "element vertex 18446744073709551615",
    "element face 3",
    "element nothing 9999999999999",
    "property float x",
    "property float f_rest_9",
    "property uchar opacity",
    "property double scale_0",
    "property list uchar int vertex_indices",
    "property list uint double extra",
    "list",
    "float",
    "end_header",
];

pub(super) fn scene(count: usize, sh_degree: usize) -> SplatData {
    let mut scene = SplatData {
        sh_degree,
        ..SplatData::default()
    };
    let value = |i: usize, k: usize| ((i * 7 + k) as f32 * 0.7).sin();
    for i in 0..count {
        scene.means.push([value(i, 0), value(i, 1), value(i, 2)]);
        scene.log_scales.push([-2.0 + value(i, 3), -2.0, -2.5]);
        scene.quats.push([1.0, value(i, 4), value(i, 5), 0.0]);
        scene.opacity_logits.push(value(i, 6));
        scene.sh0.push([value(i, 1), value(i, 2), value(i, 3)]);
        let rest = scene.sh_rest_len();
        scene.sh_rest.extend((0..rest).map(|k| 0.1 * value(i, k)));
    }
    scene
}

fn seeds() -> Vec<Input> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let file = folder.path().join("scene.ply");
    let written = |scene: &SplatData| {
        ply::write(&file, scene).expect("a valid scene");
        std::fs::read(&file).expect("the file just written")
    };
    let plain = written(&scene(3, 0));
    let mut far = scene(2, 1);
    far.origin = [1e6, -2.5, 3e5];
    let seeds = [
        plain.clone(),
        written(&far),
        written(&scene(1, 3)),
        ascii(&plain),
        big_endian(&plain),
    ];
    seeds.map(|seed| Input(vec![seed])).to_vec()
}

/// Position after the header's last line.
fn body(file: &[u8]) -> usize {
    const END: &[u8] = b"end_header\n";
    let found = file.windows(END.len()).position(|window| window == END);
    found.map_or(file.len(), |at| at + END.len())
}

/// The same scene of floats as text, with another element before it and a list after each row.
fn ascii(file: &[u8]) -> Vec<u8> {
    let (header, rows) = file.split_at(body(file));
    let header = String::from_utf8_lossy(header)
        .replace("binary_little_endian", "ascii")
        .replace(
            "element vertex",
            "element camera 2\nproperty int id\nelement vertex",
        )
        .replace("end_header", "property list uchar int extra\nend_header");
    let width = header.matches("property float").count();
    let values: Vec<f32> = rows
        .as_chunks::<4>()
        .0
        .iter()
        .map(|b| f32::from_le_bytes(*b))
        .collect();
    let mut text = header + "5\n6\n";
    for row in values.chunks(width) {
        let words: Vec<String> = row.iter().map(f32::to_string).collect();
        text += &format!("{} 2 8 9\n", words.join(" "));
    }
    text.into_bytes()
}

fn big_endian(file: &[u8]) -> Vec<u8> {
    let (header, rows) = file.split_at(body(file));
    let header = String::from_utf8_lossy(header).replace("little", "big");
    let values = rows.as_chunks::<4>().0.iter();
    let turned = values.flat_map(|b| f32::from_le_bytes(*b).to_be_bytes());
    header.into_bytes().into_iter().chain(turned).collect()
}

pub(super) fn mutate(input: &mut Input, rng: &mut Pcg64Mcg) {
    let file = &mut input.0[0];
    let at = body(file);
    let mut rest = file.split_off(at);
    let is_text = file.windows(5).any(|window| window == b"ascii");
    match rng.random_range(0..4) {
        0 if is_text => mutate::text(&mut rest, &[], rng),
        0 | 1 => mutate::bytes(&mut rest, rng),
        _ => mutate::text(file, &WORDS, rng),
    }
    file.extend(rest);
}

/// Reads a scene; an accepted one is rendered.
fn parse(input: &Input) -> Result<Follow, String> {
    let scene = ply::parse(Path::new("scene.ply"), &input.0[0]);
    let scene = scene.map_err(|error| error.to_string())?;
    Ok(Box::new(move || {
        if scene.len() > 100 {
            return false;
        }
        renders(&Gaussians::from_data(&scene, &Device::flex()))
    }))
}

/// True if rendering yields an image.
pub(super) fn renders(gaussians: &Gaussians) -> bool {
    let view = &capture().views[0];
    let camera = view.camera().relative_to(gaussians.origin);
    let cameras = CameraTensors::from_camera(&camera, &Device::flex());
    let rendered = render(gaussians, &cameras, &RenderSettings::default());
    rendered.is_ok_and(|rendered| rendered.image().try_into_vec_as::<f32>().is_ok())
}
