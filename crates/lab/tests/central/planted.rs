//! Bugs of every kind are found, with their input and element.

use burn::tensor::activation;
use splat_lab::central::{Kind, Settings, gradcheck, gradcheck_with, tensor};

use super::{assert_wrong, numbers, only, random};

/// One element of twelve is wrong by one part in 100,000.
#[test]
fn a_wrong_factor_at_one_element() {
    let mut mask = vec![0.0; 12];
    mask[7] = 1e-5;
    let mask = tensor(mask, [3, 4]);
    let report = gradcheck(
        |[x, y]| {
            let z = (x * y.clone()).exp();
            z.clone() + mask.clone() * (z.clone() - z.detach()) - y
        },
        [("x", random(1, [3, 4])), ("y", random(2, [3, 4]))],
    )
    .unwrap();
    assert_wrong(&report, "x", &[1, 3]);
    assert_wrong(&report, "y", &[1, 3]);
    let message = report.check().unwrap_err().to_string();
    assert!(message.starts_with("`x` at [1, 3]: analytic "), "{message}");
    assert!(message.ends_with("correct the backward pass"), "{message}");
}

#[test]
fn a_wrong_sign() {
    let report = gradcheck(
        |x| {
            let y = x.cos();
            y.clone().detach() * 2.0 - y
        },
        ("x", random(3, [5])),
    )
    .unwrap();
    assert_eq!(report.rows[0].findings.len(), 5, "{report}");
    assert!(
        report.rows[0]
            .findings
            .iter()
            .all(|f| f.kind == Kind::Wrong)
    );
}

/// The gradient reaches the input by only one of two paths.
#[test]
fn a_missing_term() {
    let report = gradcheck(
        |(x, w)| x.clone() * (x.detach() * w).sin(),
        (("x", random(4, [2, 3])), ("w", random(5, [1, 3]))),
    )
    .unwrap();
    assert!(!report.row("x").unwrap().is_ok(), "{report}");
    assert!(report.row("w").unwrap().is_ok(), "{report}");
}

/// Values and gradients belong to different permutations of the input.
#[test]
fn a_gradient_in_the_wrong_place() {
    let report = gradcheck(
        |x| {
            let y = x.clone() * x.clone();
            let swapped = y.clone().flip([0]);
            y.detach() + swapped.clone() - swapped.detach()
        },
        ("x", tensor([1.0, 2.0, 3.0], [3])),
    );
    let findings = report.unwrap().rows[0].findings.clone();
    assert!(!findings.is_empty());
}

#[test]
fn a_detached_input() {
    let report = gradcheck(
        |(a, b)| a.matmul(b.detach()),
        (("a", random(6, [2, 3])), ("b", random(7, [3, 2]))),
    )
    .unwrap();
    assert!(report.row("a").unwrap().is_ok(), "{report}");
    let b = report.row("b").unwrap();
    assert_eq!(b.findings[0].kind, Kind::NoGradient, "{report}");
    let message = report.check().unwrap_err().to_string();
    assert!(
        message.starts_with("`b` at [0, 0]: no gradient"),
        "{message}"
    );
}

/// Behind a dead ReLU a detached input looks like any other. The report says that everything is
/// zero.
#[test]
fn an_input_without_influence_is_named() {
    for elements in [0, 1000] {
        let report = gradcheck_with(
            |(x, y)| activation::relu(x.detach() - 10.0) + y,
            (("x", random(13, [3])), ("y", random(14, [3]))),
            &Settings::new().with_each_up_to(elements),
        )
        .unwrap();
        report.expect();
        assert!(report.row("x").unwrap().all_zero, "{report}");
        assert!(!report.row("y").unwrap().all_zero, "{report}");
        assert!(report.to_string().contains("ok, all zero"), "{report}");
    }
}

#[test]
fn everything_detached() {
    let report = gradcheck(|x| x.detach().exp(), ("x", random(8, [3]))).unwrap();
    assert_eq!(
        report.rows[0].findings[0].kind,
        Kind::NoGradient,
        "{report}"
    );
}

/// ReLU at zero: Burn's 0 is the slope on the left.
#[test]
fn a_kink_is_named_with_both_slopes() {
    let x = || ("x", tensor([0.5, 0.0, -0.5], [3]));
    let settings = Settings::new().with_upstream([1.0, 2.0, 1.0]);
    let report = gradcheck_with(activation::relu, x(), &settings).unwrap();
    report.expect();
    let finding = only(&report, "x");
    let Kind::Kink {
        left,
        right,
        accepted: true,
    } = finding.kind
    else {
        panic!("{report}");
    };
    assert!(left.abs() < 1e-6 && (right - 2.0).abs() < 1e-6, "{report}");
    assert_eq!(finding.comparison.at, Some(vec![1]));

    let report = gradcheck_with(activation::relu, x(), &settings.with_kinks_refused()).unwrap();
    assert!(!report.is_ok(), "{report}");
    assert!(report.check().unwrap_err().to_string().contains("a kink"));
}

/// At a kink, a gradient outside both slopes is wrong.
#[test]
fn a_wrong_gradient_at_a_kink() {
    let report = gradcheck(
        |x| {
            let y = x.clone().abs();
            y + x.clone() * 3.0 - x.detach() * 3.0
        },
        ("x", tensor([0.0], [1])),
    )
    .unwrap();
    assert!(
        matches!(
            only(&report, "x").kind,
            Kind::Kink {
                accepted: false,
                ..
            }
        ),
        "{report}"
    );
    assert!(!report.is_ok());
}

/// A kink one part in a million from the point does not count.
#[test]
fn a_kink_beside_the_point_is_not_named() {
    let x = tensor([1e-6, -1e-5, 0.3, 0.8], [4]);
    let report = gradcheck(activation::relu, ("x", x)).unwrap();
    report.expect();
    assert!(report.rows[0].findings.is_empty(), "{report}");
}

/// A maximum of two equal inputs: a kink in both.
#[test]
fn a_kink_between_inputs() {
    let report = gradcheck(
        |[x, y]| x.max_pair(y),
        [
            ("x", tensor([1.0, 2.0, 0.3], [3])),
            ("y", tensor([0.0, 2.0, 0.7], [3])),
        ],
    )
    .unwrap();
    for input in ["x", "y"] {
        let finding = only(&report, input);
        assert!(matches!(finding.kind, Kind::Kink { .. }), "{report}");
        assert_eq!(finding.comparison.at, Some(vec![1]), "{report}");
    }
}

/// The sign function has no derivative at zero that differences could determine.
#[test]
fn a_jump_is_not_passed() {
    let report = gradcheck(
        |x| x.clone().sign() + x.sin(),
        ("x", tensor([0.4, 0.0], [2])),
    )
    .unwrap();
    let finding = only(&report, "x");
    assert_eq!(finding.kind, Kind::Unresolved, "{report}");
    assert_eq!(finding.comparison.at, Some(vec![1]), "{report}");
}

/// A bug in a gradient that is small compared with another input's.
#[test]
fn small_gradients_have_their_own_scale() {
    let report = gradcheck(
        |(x, y)| x * 1e4 + y.clone() * 1e-4 - y.detach() * 1e-6,
        (("x", random(9, [3])), ("y", random(10, [3]))),
    )
    .unwrap();
    assert!(report.row("x").unwrap().is_ok(), "{report}");
    assert!(!report.row("y").unwrap().is_ok(), "{report}");
}

/// Each of several outputs counts.
#[test]
fn a_bug_in_the_second_output() {
    let report = gradcheck(
        |x| (x.clone().sin(), (x.clone() * x.detach()).sum()),
        ("x", random(11, [4])),
    )
    .unwrap();
    assert!(!report.is_ok(), "{report}");
}

/// In a large input kinks are searched one by one. Ten are too many, and whatever they may hide
/// does not pass.
#[test]
fn too_many_kinks_in_a_large_input() {
    let mut values = numbers(12, 2000);
    values[100..110].fill(0.0);
    let report = gradcheck(activation::relu, ("x", tensor(values, [2000]))).unwrap();
    assert!(!report.is_ok(), "{report}");
    let message = report.check().unwrap_err().to_string();
    assert!(
        message.contains("more kinks than are looked for"),
        "{message}"
    );
}
