//! COLMAP's model as text: three files of lines.

use rand::RngExt;
use rand_pcg::Pcg64Mcg;

use super::colmap::Model;
use super::{Input, Target, colmap_binary, per_byte};
use crate::mutate;

pub(super) const TARGET: Target = Target {
    name: "colmap_text",
    file: ".txt",
    seeds,
    mutate,
    parse: |input| colmap_binary::parse(false, input),
    follow_every: 64,
    memory: per_byte(16),
};

const WORDS: [&str; 13] = [
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "OPENCV",
    "FULL_OPENCV",
    "SIMPLE_RADIAL",
    "SIMPLE_FISHEYE",
    "# Number of images: 5,",
    "# Number of images: 99999999999999999999",
    "1.5 2.5 -1",
    "0 0 0 0",
    "view 0.png",
    "7",
    "2",
];

fn seeds() -> Vec<Input> {
    vec![Model::small().text()]
}

fn mutate(input: &mut Input, rng: &mut Pcg64Mcg) {
    let part = rng.random_range(0..3);
    mutate::text(&mut input.0[part], &WORDS, rng);
}
