//! Settings of a run, as TOML.

use rand_pcg::Pcg64Mcg;
use splat_trainer::TrainSettings;

use super::{Follow, Input, Target, capture, per_byte, train_steps};
use crate::mutate;

pub(super) const TARGET: Target = Target {
    name: "config",
    file: "config.toml",
    seeds,
    mutate: |input, rng: &mut Pcg64Mcg| mutate::text(&mut input.0[0], &WORDS, rng),
    parse,
    follow_every: 64,
    memory: per_byte(1_024),
};

const WORDS: [&str; 24] = [
    "steps = 3",
    "steps",
    "background = [0.1, nan, inf]",
    "[density]",
    "[rates]",
    "[init]",
    "max_gaussians = 0",
    "max_gaussians = 1",
    "every = 1",
    "start = 0",
    "sh_degree = 3",
    "coarse_halvings = 8",
    "coarse_every = 9223372036854775807",
    "reset_every = 1",
    "true",
    "=",
    "[",
    "]",
    "[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[",
    "{a={a={a={a={a={a={a={a={a={a={a={a={a={a={a={a={a={a={a={a={a={",
    "\"\"\"",
    "'",
    "a.b.c.d.e.f.g.h.i.j.k.l.m.n.o.p.q.r.s.t.u.v.w.x.y.z = 1",
    "1979-05-27T07:32:00Z",
];

fn seeds() -> Vec<Input> {
    let default = TrainSettings {
        background: Some([0.1, 0.2, 0.3]),
        steps: 8,
        ..TrainSettings::default()
    };
    let mut busy = TrainSettings {
        steps: 4,
        coarse_halvings: 1,
        antialias: true,
        ..TrainSettings::default()
    };
    busy.density.every = 1;
    busy.density.reset_every = 1;
    busy.density.max_gaussians = Some(100);
    let text = |config: &TrainSettings| toml::to_string(config).expect("settings are TOML");
    let texts = [
        format!(
            "# splat 0.1.0 on a device; to repeat: ...\n{}",
            text(&default)
        ),
        text(&busy),
        String::new(),
    ];
    texts.map(|text| Input(vec![text.into_bytes()])).to_vec()
}

/// Reads settings; accepted ones start a run.
fn parse(input: &Input) -> Result<Follow, String> {
    let config = TrainSettings::parse(&input.0[0]);
    // As the program reports it, with the file in front.
    let config = config.map_err(|reason| format!("config.toml: {reason}"))?;
    Ok(Box::new(move || train_steps(capture(), config, None)))
}
