//! Points of a capture as PLY, with positions and colours.

use rand_pcg::Pcg64Mcg;
use splat_data::capture::in_memory::parse_points;

use super::{Follow, Input, Memory, Target, ply};

pub(super) const TARGET: Target = Target {
    name: "points",
    file: "points.ply",
    seeds,
    mutate,
    parse,
    follow_every: 64,
    // As for scenes.
    memory: Memory {
        per_byte: 32,
        constant: 8 * 65_536 + (8 << 10),
    },
};

/// Three points as text, of bytes and floats, and with doubles and without colours.
fn seeds() -> Vec<Input> {
    let head = |format: &str, real: &str, colors: &str| {
        format!(
            "ply\nformat {format} 1.0\ncomment points\nelement vertex 3\nproperty {real} x\n\
             property {real} y\nproperty {real} z\n{colors}end_header\n"
        )
    };
    let bytes = "property uchar red\nproperty uchar green\nproperty uchar blue\n";
    let floats =
        "property list uchar int seen\nproperty float r\nproperty float g\nproperty float b\n";
    let text = head("ascii", "float", bytes) + "1 2 3 4 5 6\n-1 0 0.5 255 0 9\n0 0 0 7 7 7\n";
    let lists = head("ascii", "double", floats)
        + "1 2 3 2 8 9 0 0.5 1\n-1 0 0.5 0 1 1 1\n0 0 0 1 3 0 0 0\n";
    let mut binary = head("binary_little_endian", "float", bytes).into_bytes();
    let mut plain = head("binary_big_endian", "double", "").into_bytes();
    for i in 0..3u8 {
        let position = [f32::from(i), -0.5, 2.0];
        binary.extend(position.iter().flat_map(|x| x.to_le_bytes()));
        binary.extend([i, 100, 255]);
        plain.extend(position.iter().flat_map(|x| f64::from(*x).to_be_bytes()));
    }
    let seeds = [text.into_bytes(), lists.into_bytes(), binary, plain];
    seeds.map(|seed| Input(vec![seed])).to_vec()
}

fn mutate(input: &mut Input, rng: &mut Pcg64Mcg) {
    ply::mutate(input, rng);
}

/// Reads the points; the next stage is to find any.
fn parse(input: &Input) -> Result<Follow, String> {
    let points = parse_points("points.ply", &input.0[0]);
    let points = points.map_err(|error| error.to_string())?;
    Ok(Box::new(move || {
        let finite = |point: &splat_data::Point| point.position.iter().all(|x| x.is_finite());
        assert!(points.iter().all(finite), "a position is not finite");
        !points.is_empty()
    }))
}
