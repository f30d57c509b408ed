//! Fixtures of `scripts/fixtures.py`: a difference in any of their tensors is found.

use burn::tensor::{Tensor, activation};
use splat_lab::central::{Kind, NamedTensors, check_against_fixture};

use super::ten::fixture;

fn sin_exp(at: &NamedTensors) -> Tensor<2> {
    let (x, y) = (at.get::<2>("x"), at.get::<2>("y"));
    (x.clone() * y.clone()).sin() * (y * 0.5).exp() + x.tanh()
}

#[test]
fn the_twin_agrees() {
    let report = fixture("sin_exp").check(sin_exp).unwrap();
    println!("{report}");
    report.expect();
    assert!(report.worst_relative() < 1e-12, "{report}");
}

#[test]
fn another_value_is_found() {
    let report = fixture("sin_exp")
        .check(|at: &NamedTensors| sin_exp(at) + 1e-8)
        .unwrap();
    assert_eq!(
        report.row("output").unwrap().findings[0].kind,
        Kind::Wrong,
        "{report}"
    );
    assert!(report.row("grad.x").unwrap().is_ok(), "{report}");
}

#[test]
fn another_gradient_is_found() {
    let twin = |at: &NamedTensors| {
        let y = sin_exp(at);
        y.clone() + (y.clone() - y.detach()) * 1e-8
    };
    let report = fixture("sin_exp").check(twin).unwrap();
    assert!(report.row("output").unwrap().is_ok(), "{report}");
    assert_eq!(
        report.row("grad.x").unwrap().findings[0].kind,
        Kind::Wrong,
        "{report}"
    );
    fixture("sin_exp")
        .with_tolerance(1e-7)
        .check(twin)
        .unwrap()
        .expect();
}

#[test]
fn a_missing_gradient_is_found() {
    let report = fixture("softmax")
        .check(|at: &NamedTensors| activation::softmax(at.get::<2>("x").detach(), 1))
        .unwrap();
    let finding = &report.row("grad.x").unwrap().findings[0];
    assert_eq!(finding.kind, Kind::NoGradient, "{report}");
}

#[test]
fn another_shape_is_an_error() {
    let error = fixture("softmax").check(|at: &NamedTensors| at.get::<2>("x").sum_dim(1));
    let error = error.unwrap_err().to_string();
    assert!(
        error.contains("[[4, 6]], the function's have [[4, 1]]"),
        "{error}"
    );
}

/// A file from its header and numbers.
fn file(header: &str, values: &[f64]) -> tempfile::NamedTempFile {
    use std::io::Write;
    let mut file = tempfile::NamedTempFile::new().unwrap();
    file.write_all(&(header.len() as u64).to_le_bytes())
        .unwrap();
    file.write_all(header.as_bytes()).unwrap();
    for value in values {
        file.write_all(&value.to_le_bytes()).unwrap();
    }
    file
}

#[test]
fn constants_and_several_outputs() {
    let entry = |name, at: usize| {
        format!(
            r#""{name}":{{"dtype":"F64","shape":[1],"data_offsets":[{},{}]}}"#,
            8 * at,
            8 * at + 8
        )
    };
    let names = ["c", "grad.x", "grad_y", "grad_z", "x", "y", "z"];
    let entries: Vec<_> = names
        .iter()
        .enumerate()
        .map(|(i, name)| entry(name, i))
        .collect();
    let header = format!(
        r#"{{"__metadata__":{{"outputs":"z,y"}},{}}}"#,
        entries.join(",")
    );
    // y = c x, z = x^2 at c = 3, x = 2; upstream 10 and 100: 10 c + 100 * 2 x = 430.
    let file = file(&header, &[3.0, 430.0, 10.0, 100.0, 2.0, 6.0, 4.0]);
    let twin = |at: &NamedTensors| {
        let (x, c) = (at.get::<1>("x"), at.get::<1>("c"));
        (x.clone() * x.clone(), x * c)
    };
    let report = check_against_fixture(file.path(), twin).unwrap();
    report.expect();
    assert_eq!(report.rows.len(), 4, "{report}");
}

#[test]
fn files_that_do_not_fit_are_refused() {
    let cases = [
        ("{}", "metadata `outputs` is missing"),
        (
            r#"{"__metadata__":{"outputs":"y"}}"#,
            "tensor `y` is missing",
        ),
        (
            r#"{"__metadata__":{"outputs":"y"},"y":{"dtype":"F64","shape":[1],"data_offsets":[0,8]}}"#,
            "tensor `grad_y` is missing",
        ),
        (
            r#"{"__metadata__":{"outputs":"y"},"y":{"dtype":"F64","shape":[1],"data_offsets":[0,8]},"y":{"dtype":"F64","shape":[1],"data_offsets":[0,8]}}"#,
            "`y` occurs twice",
        ),
        ("[]", "not a safetensors file"),
    ];
    for (header, reason) in cases {
        let values = [1.0];
        let count = usize::from(header.contains("F64"));
        let file = file(header, &values[..count]);
        let error = check_against_fixture(file.path(), |at: &NamedTensors| at.get::<1>("x"));
        let error = error.unwrap_err().to_string();
        assert!(error.contains(reason), "{error}");
        assert!(
            error.contains(&file.path().display().to_string()),
            "{error}"
        );
    }
}
