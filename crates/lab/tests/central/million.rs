//! Inputs of a million elements.

use burn::tensor::{Tensor, activation};
use splat_lab::central::{Coverage, Kind, Report, Settings, gradcheck, gradcheck_with, tensor};

use super::{assert_wrong, only, random};

const MILLION: usize = 1_000_000;
const WRONG_AT: usize = 654_321;

/// As in `generate.py`.
fn input() -> Tensor<1> {
    let value = |i: u64| ((i * 2654435761) % (1 << 32)) as f64 / (1u64 << 30) as f64 - 2.0;
    let values: Vec<f64> = (0..MILLION as u64).map(value).collect();
    tensor(values, [MILLION])
}

fn mask(at: usize, error: f64) -> Tensor<1> {
    let mut mask = vec![0.0; MILLION];
    mask[at] = error;
    tensor(mask, [MILLION])
}

/// The value of `y`, with its gradient times 1 + mask.
fn spoilt<const D: usize>(y: Tensor<D>, mask: Tensor<D>) -> Tensor<D> {
    y.clone() + mask * (y.clone() - y.detach())
}

pub fn one_in_a_million() -> Report {
    let mask = mask(WRONG_AT, 0.01);
    gradcheck(|x| spoilt(x.sin(), mask.clone()), ("x", input())).unwrap()
}

pub fn wrong_gradient() -> Vec<f64> {
    let x = input().require_grad();
    let grads = spoilt(x.clone().sin(), mask(WRONG_AT, 0.01))
        .sum()
        .backward();
    x.grad(&grads).unwrap().try_into_vec_as().unwrap()
}

fn limit(report: &Report) -> f64 {
    match report.rows[0].coverage {
        Coverage::Directions { limit, .. } => limit,
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_right_function_passes() {
    let report = gradcheck(|x| x.sin(), ("x", input())).unwrap();
    println!("sin: sees {:.1e}", limit(&report));
    report.expect();
    assert!(limit(&report) < 1e-3, "{report}");
}

#[test]
fn one_wrong_element_is_found_wherever_it_is() {
    for at in [0, MILLION - 1] {
        let mask = mask(at, -0.01);
        let report = gradcheck(|x| spoilt(x.sin(), mask.clone()), ("x", input())).unwrap();
        assert_wrong(&report, "x", &[at]);
    }
}

/// The limit stated in the report holds: an element beyond it is found, and one far below it is
/// not. With `--nocapture`, prints the numbers of docs/GRADCHECK.md.
#[test]
fn the_limit_is_where_the_report_says() {
    let x = input();
    let stated = limit(&gradcheck(|x| x.sin(), ("x", x.clone())).unwrap());
    let mut least = f64::INFINITY;
    for exponent in 3..9 {
        let error = 10f64.powi(-exponent);
        let mask = mask(WRONG_AT, error);
        let report = gradcheck(|x| spoilt(x.sin(), mask.clone()), ("x", x.clone())).unwrap();
        println!(
            "relative error {error:.0e} at one element: found {}",
            !report.is_ok()
        );
        if report.is_ok() {
            break;
        }
        assert_wrong(&report, "x", &[WRONG_AT]);
        least = error;
    }
    // This element's gradient is of the order of the root mean square.
    assert!(
        least <= 10.0 * stated && least >= stated / 100.0,
        "{least} {stated}"
    );
}

/// With a tolerance at rounding level, smaller errors are seen.
#[test]
fn a_smaller_tolerance_sees_more() {
    let mask = mask(WRONG_AT, 1e-6);
    let settings = Settings::new().with_tolerance(1e-12);
    let report =
        gradcheck_with(|x| spoilt(x.sin(), mask.clone()), ("x", input()), &settings).unwrap();
    assert_wrong(&report, "x", &[WRONG_AT]);
    let report = gradcheck_with(|x| x.sin(), ("x", input()), &settings).unwrap();
    println!("sin with tolerance 1e-12: sees {:.1e}", limit(&report));
    report.expect();
}

/// Two errors that cancel in a sum are still found.
#[test]
fn two_wrong_elements_are_both_found() {
    let mut errors = vec![0.0; MILLION];
    (errors[77], errors[888_888]) = (0.01, 0.01);
    let mask = tensor(errors, [MILLION]);
    let report = gradcheck(|x| spoilt(x.sin(), mask.clone()), ("x", input())).unwrap();
    let found: Vec<_> = report.rows[0]
        .findings
        .iter()
        .map(|f| f.comparison.at.clone())
        .collect();
    assert_eq!(found, [Some(vec![77]), Some(vec![888_888])], "{report}");
}

/// Functions that mix all elements, and outputs of one element: the search needs no elementwise
/// function.
#[test]
fn functions_that_mix_elements() {
    let x = || ("x", random(5, [1000, 1000]));
    let narrow = random(6, [1000, 8]);
    let wrong = {
        let mut mask = vec![0.0; MILLION];
        mask[123_456] = 0.01;
        tensor(mask, [1000, 1000])
    };
    let cases: [(&str, &dyn Fn(Tensor<2>) -> Tensor<2>); 3] = [
        ("softmax of rows", &|x| activation::softmax(x, 1)),
        ("matmul", &|x| x.matmul(narrow.clone())),
        ("norm", &|x| x.square().sum().sqrt().unsqueeze()),
    ];
    for (name, function) in cases {
        let right = gradcheck(function, x()).unwrap();
        println!("{name}: sees {:.1e}", limit(&right));
        right.expect();
        let report = gradcheck(|x| function(spoilt(x, wrong.clone())), x()).unwrap();
        assert_wrong(&report, "x", &[123, 456]);
    }
}

/// Thousands of elements have a kink within the largest step; one has it at the point, and one is
/// wrong.
#[test]
fn kinks_all_over() {
    let mut values = super::numbers(7, MILLION);
    values[300_000] = 0.0;
    let x = || ("x", tensor(values.clone(), [MILLION]));
    let report = gradcheck(activation::relu, x()).unwrap();
    println!("relu: sees {:.1e}", limit(&report));
    report.expect();
    let finding = only(&report, "x");
    assert!(
        matches!(finding.kind, Kind::Kink { accepted: true, .. }),
        "{report}"
    );
    assert_eq!(finding.comparison.at, Some(vec![300_000]), "{report}");

    let wrong = (700_000..).find(|i| values[*i] > 0.5).unwrap();
    let mask = mask(wrong, 0.01);
    let report = gradcheck(|x| spoilt(activation::relu(x), mask.clone()), x()).unwrap();
    let findings = &report.rows[0].findings;
    assert_eq!(findings.len(), 2, "{report}");
    assert!(
        findings
            .iter()
            .any(|f| f.kind == Kind::Wrong && f.comparison.at == Some(vec![wrong])),
        "{report}"
    );
}
