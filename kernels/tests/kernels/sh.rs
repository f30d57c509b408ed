//! Tests of spherical harmonics and their gradients.

use splat_kernels::sh;

use crate::device::{assert_close, client, differences, download, rng, uniform, upload, wide};
use crate::reference;

const STORED: usize = 16;
const GAUSSIANS: usize = 20;
const CAMERAS: usize = 2;

fn reference_all(coefficients: &[f64], dirs: &[f64], degree: usize) -> Vec<f64> {
    (0..CAMERAS * GAUSSIANS)
        .flat_map(|i| {
            let first = i % GAUSSIANS * STORED * 3;
            reference::spherical_harmonics(
                &coefficients[first..first + STORED * 3],
                &dirs[i * 3..i * 3 + 3],
                degree,
            )
        })
        .collect()
}

#[test]
fn every_degree_and_its_gradients_agree_with_float64() {
    let Some(client) = client() else { return };
    let mut rng = rng(10);
    let coefficients = uniform(&mut rng, GAUSSIANS * STORED * 3, -1.0, 1.0);
    let dirs = uniform(&mut rng, CAMERAS * GAUSSIANS * 3, -3.0, 3.0);
    let weights = uniform(&mut rng, dirs.len(), -1.0, 1.0);
    let (c, d, g) = (
        upload(&client, &coefficients),
        upload(&client, &dirs),
        upload(&client, &weights),
    );
    let (coefficients, dirs, weights) = (wide(&coefficients), wide(&dirs), wide(&weights));
    let loss = |c: &[f64], d: &[f64], degree| -> f64 {
        reference_all(c, d, degree)
            .iter()
            .zip(&weights)
            .map(|(a, b)| a * b)
            .sum()
    };
    for degree in 0..=3 {
        let colors = download(&client, &sh::evaluate(&client, &c, &d, STORED, degree));
        assert_close(
            &format!("degree {degree}"),
            &colors,
            &reference_all(&coefficients, &dirs, degree),
            1e-6,
        );
        let [grad_c, grad_d] =
            sh::evaluate_backward(&client, &c, &d, &g, STORED, degree, [true; 2]);
        let expected = differences(&coefficients, 1e-5, |x| loss(x, &dirs, degree));
        assert_close(
            "coefficients",
            &download(&client, &grad_c.unwrap()),
            &expected,
            1e-6,
        );
        let expected = differences(&dirs, 1e-5, |x| loss(&coefficients, x, degree));
        assert_close(
            "dirs",
            &download(&client, &grad_d.unwrap()),
            &expected,
            1e-5,
        );
    }
}

#[test]
fn the_zero_direction_has_a_colour_and_no_gradient() {
    let Some(client) = client() else { return };
    let c = upload(&client, &[1.0; 48]);
    let d = upload(&client, &[0.0; 3]);
    let colors = download(&client, &sh::evaluate(&client, &c, &d, 16, 3));
    assert_close("colour", &colors, &[0.28209479177387814; 3], 1e-6);
    let [_, grad] = sh::evaluate_backward(
        &client,
        &c,
        &d,
        &upload(&client, &[1.0; 3]),
        16,
        3,
        [false, true],
    );
    assert_eq!(download(&client, &grad.unwrap()), [0.0; 3]);
}
