//! The exponential and the logistic function, compared with float64.

use splat_core::Activation;
use splat_kernels::activation::{activate, activate_vjp};

use crate::device::{client, download, upload};

/// Values, and gradients from an upstream gradient of 2.
fn run(values: &[f32], function: Activation) -> Option<[Vec<f32>; 2]> {
    let client = client()?;
    let x = upload(&client, values);
    let y = activate(&client, x.clone(), function);
    let grad = upload(&client, &vec![2.0; values.len()]);
    let grad = activate_vjp(&client, [&x, &y], grad, function);
    Some([download(&client, &y), download(&client, &grad)])
}

fn check(what: &str, found: &[f32], x: &[f32], expected: impl Fn(f64) -> f64, limit: f64) {
    let errors = found.iter().zip(x).map(|(found, x)| {
        let error = (f64::from(*found) / expected(f64::from(*x)) - 1.0).abs();
        if error.is_nan() { f64::INFINITY } else { error }
    });
    let worst = errors.fold(0.0, f64::max);
    println!("{what}: relative error {worst:.1e}");
    assert!(worst <= limit, "{what}: relative error {worst:e}");
}

#[test]
fn values_and_gradients_keep_their_digits_over_the_whole_range() {
    let x: Vec<f32> = (-87_000..=88_000).map(|i| i as f32 * 1e-3).collect();
    let Some([y, grad]) = run(&x, Activation::Exp) else {
        return;
    };
    check("exp", &y, &x, f64::exp, 2.5e-7);
    check("its gradient", &grad, &x, |x| 2.0 * x.exp(), 2.5e-7);
    // Within the range of normal numbers.
    let x: Vec<f32> = (-86_000..=86_000).map(|i| i as f32 * 1e-3).collect();
    let Some([y, grad]) = run(&x, Activation::Sigmoid) else {
        return;
    };
    let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
    let slope = |x: f64| 2.0 * sigmoid(x) * sigmoid(-x);
    check("sigmoid", &y, &x, sigmoid, 4e-7);
    check("its gradient", &grad, &x, slope, 6e-7);
}

#[test]
fn beyond_the_range_there_are_infinity_and_zero() {
    let x = [89.0, 1e30, f32::INFINITY, -1e30, f32::NEG_INFINITY, 0.0];
    let Some([y, _]) = run(&x, Activation::Exp) else {
        return;
    };
    let infinity = f32::INFINITY;
    assert_eq!(y, [infinity, infinity, infinity, 0.0, 0.0, 1.0]);
    let Some([y, slope]) = run(&x, Activation::Sigmoid) else {
        return;
    };
    assert_eq!(y, [1.0, 1.0, 1.0, 0.0, 0.0, 0.5]);
    assert_eq!(slope[1..], [0.0, 0.0, 0.0, 0.0, 0.5]);
}
