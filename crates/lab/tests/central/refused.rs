//! Functions that cannot be checked, and the messages.

use std::cell::Cell;

use burn::tensor::{DType, Tensor};
use splat_lab::central::{
    CheckError, Inputs, NamedTensors, Report, Settings, gradcheck, gradcheck_with, tensor,
};

fn message(result: Result<Report, CheckError>) -> String {
    result
        .map(|report| report.to_string())
        .unwrap_err()
        .to_string()
}

fn x() -> (&'static str, Tensor<1>) {
    ("x", tensor([1.0, -2.0], [2]))
}

#[test]
fn an_output_that_is_not_finite() {
    let message = message(gradcheck(|x| x.log(), x()));
    assert!(message.starts_with("output 0 is NaN at [1]"), "{message}");
}

#[test]
fn a_gradient_that_is_not_finite() {
    let zero = ("x", tensor([4.0, 0.0], [2]));
    let settings = Settings::new().with_upstream([1.0, 1.0]);
    let message = message(gradcheck_with(|x| x.sqrt(), zero, &settings));
    assert!(
        message.starts_with("the gradient of input `x` is inf at [1]"),
        "{message}"
    );
}

/// Finite at the point, with a finite gradient, but at no step from it.
#[test]
fn a_point_at_the_edge_of_the_domain() {
    let zero = ("x", tensor([0.0, 4.0], [2]));
    let report = gradcheck(|x| x.clone().sqrt().detach() + x, zero).unwrap();
    let message = report.check().unwrap_err().to_string();
    assert!(
        message.starts_with("`x` at [0]: the function is not finite beside"),
        "{message}"
    );
}

#[test]
fn an_input_that_is_not_finite() {
    let message = message(gradcheck(|x| x, ("x", tensor([f64::NAN], [1]))));
    assert!(message.starts_with("input `x` is NaN at [0]"), "{message}");
}

#[test]
fn an_error_of_the_function() {
    let failing = |_| Err::<Tensor<1>, _>("no such shape");
    assert_eq!(
        message(gradcheck(failing, x())),
        "the function failed: no such shape"
    );
}

#[test]
fn another_precision() {
    let message = message(gradcheck(|x| x.cast(DType::F32), x()));
    assert!(
        message.contains("output 0 has type F32, must be F64"),
        "{message}"
    );
}

#[test]
fn a_function_with_a_state() {
    let calls = Cell::new(0.0);
    let message = message(gradcheck(
        |x| {
            calls.set(calls.get() + 1.0);
            x * calls.get()
        },
        x(),
    ));
    assert!(message.contains("when computed again"), "{message}");
}

#[test]
fn inputs_that_cannot_be_told_apart() {
    let inputs = [x(), x()];
    assert_eq!(
        message(gradcheck(|[a, b]| a + b, inputs)),
        "inputs: two are named `x`"
    );
    let none = message(gradcheck(|_: NamedTensors| x().1, Inputs::new()));
    assert_eq!(none, "inputs: there are none");
}

#[test]
fn settings_that_do_not_fit() {
    let check = |settings: Settings| message(gradcheck_with(|x| x.sin(), x(), &settings));
    assert!(check(Settings::new().with_tolerance(f64::NAN)).contains("tolerance is NaN"));
    assert!(check(Settings::new().with_step(0.0)).contains("step is 0"));
    assert!(check(Settings::new().with_directions(0)).contains("directions are 0"));
    assert!(check(Settings::new().with_constant("y")).contains("constant `y` is no input"));
    assert!(check(Settings::new().with_upstream([1.0])).contains("1 upstream gradients"));
}

#[test]
fn a_constant_is_not_differentiated() {
    let settings = Settings::new().with_constant("mask");
    let report = gradcheck_with(
        |[x, mask]| x.sin() * mask.detach(),
        [x(), ("mask", tensor([1.0, 0.0], [2]))],
        &settings,
    )
    .unwrap();
    report.expect();
    assert!(report.to_string().contains("constant"), "{report}");
}

/// Inputs may have any float type; the check computes in double precision.
#[test]
fn inputs_in_single_precision() {
    let single = x().1.cast(DType::F32);
    let report = gradcheck(|x| x.sin(), ("x", single)).unwrap();
    report.expect();
    assert!(report.worst_relative() < 1e-9, "{report}");
}

#[test]
#[should_panic(expected = "there is no input `y`; there are [\"x\"]")]
fn an_unknown_name() {
    let _ = gradcheck(
        |at: NamedTensors| at.get::<1>("y"),
        Inputs::new().with("x", x().1),
    );
}
