//! Ten functions, five of them with a planted bug, compared with PyTorch's verdicts, which
//! `generate.py` wrote.

use std::path::Path;

use burn::tensor::{Tensor, activation};
use serde_json::Value;
use splat_lab::central::{Fixture, Kind, NamedTensors, Report, Settings, gradcheck_with};

use super::million;

type Twin = fn(&NamedTensors) -> Tensor<2>;

/// All except the one with a million elements.
const NINE: [(&str, Twin); 9] = [
    ("matmul", |at| at.get::<2>("a").matmul(at.get("b"))),
    ("softmax", |at| activation::softmax(at.get::<2>("x"), 1)),
    ("sin_exp", |at| {
        let (x, y) = (at.get::<2>("x"), at.get::<2>("y"));
        (x.clone() * y.clone()).sin() * (y * 0.5).exp() + x.tanh()
    }),
    ("norm", |at| {
        let x = at.get::<2>("x");
        x.clone() / x.square().sum_dim(1).sqrt()
    }),
    ("cumprod", |at| {
        let x = at.get::<2>("x");
        let log = (-x.clone()).log1p();
        x * (log.clone().cumsum(1) - log).exp()
    }),
    ("wrong_factor", |at| {
        let y = at.get::<2>("x").sin();
        y.clone() + (y.clone() - y.detach()) * 0.01
    }),
    ("missing_term", |at| {
        let x = at.get::<2>("x");
        x.clone().detach() * x.sin()
    }),
    ("detached_input", |at| {
        at.get::<2>("x") * at.get::<2>("y").detach().exp()
    }),
    ("kink", |at| activation::relu(at.get::<2>("x"))),
];

fn folder() -> &'static Path {
    Path::new(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/tests/central/fixtures"
    ))
}

pub fn fixture(name: &str) -> Fixture {
    Fixture::read(folder().join(format!("{name}.safetensors"))).unwrap()
}

pub fn verdicts() -> Value {
    let text = std::fs::read_to_string(folder().join("verdicts.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

/// Our verdict in one word, and the kinds of findings.
fn verdict(report: &Report) -> (&'static str, Vec<Kind>) {
    let kinds = report.rows.iter().flat_map(|row| &row.findings);
    let kinds: Vec<_> = kinds.map(|finding| finding.kind).collect();
    let word = match kinds.first() {
        None => "passes",
        Some(Kind::Wrong) => "wrong",
        Some(Kind::NoGradient) => "no gradient",
        Some(Kind::Kink { accepted: true, .. }) => "passes, kink named",
        Some(_) => "fails",
    };
    (word, kinds)
}

/// With `--nocapture`, prints the rows of the table in docs/GRADCHECK.md.
#[test]
fn verdicts_beside_pytorch() {
    let theirs = verdicts();
    let mut words = Vec::new();
    for (name, function) in NINE {
        let fixture = fixture(name);
        let settings = Settings::new().with_upstream(fixture.upstream());
        let report = gradcheck_with(
            |at: NamedTensors| function(&at),
            fixture.inputs(),
            &settings,
        )
        .unwrap();
        words.push((name, verdict(&report), report));
    }
    let report = million::one_in_a_million();
    words.insert(8, ("one_in_a_million", verdict(&report), report));

    for (name, (word, kinds), report) in &words {
        let theirs = &theirs["functions"][name];
        let passes = theirs["passes"].as_bool().unwrap();
        let error = theirs["worst_error"].as_f64();
        println!(
            "| {name} | {word} | {:.0e} | {} | {} |",
            report.worst_relative(),
            if passes { "passes" } else { "fails" },
            error.map_or("-".into(), |error| format!("{error:.0e}")),
        );
        let expected = match *name {
            "wrong_factor" | "missing_term" | "one_in_a_million" => "wrong",
            "detached_input" => "no gradient",
            "kink" => "passes, kink named",
            _ => "passes",
        };
        assert_eq!(*word, expected, "{report}");
        assert!(
            kinds.windows(2).all(|two| same_kind(two[0], two[1])),
            "{report}"
        );
        // The differences: PyTorch's fast mode misses the one element, and takes the kink for a
        // wrong gradient.
        let differ = matches!(*name, "one_in_a_million" | "kink");
        assert_eq!(passes == report.is_ok(), !differ, "{report}");
    }
}

fn same_kind(a: Kind, b: Kind) -> bool {
    std::mem::discriminant(&a) == std::mem::discriminant(&b)
}

/// All ten gradients, including those of the bugs, equal PyTorch's, so both check the same
/// function.
#[test]
fn gradients_are_those_of_pytorch() {
    for (name, function) in NINE {
        let report = fixture(name).check(function).unwrap();
        let wrong: Vec<_> = report.rows.iter().filter(|row| !row.is_ok()).collect();
        match name {
            // PyTorch's zeros for a detached input are "no gradient" here, and equal.
            "detached_input" | "kink" => assert!(report.worst_relative() <= 1e-12, "{report}"),
            _ => assert!(wrong.is_empty(), "{report}"),
        }
        report.expect();
    }
    let ours = million::wrong_gradient();
    for (i, theirs) in verdicts()["functions"]["one_in_a_million"]["gradient"]
        .as_object()
        .unwrap()
    {
        let (ours, theirs) = (ours[i.parse::<usize>().unwrap()], theirs.as_f64().unwrap());
        assert!((ours - theirs).abs() < 1e-14, "{i}: {ours} {theirs}");
    }
}
