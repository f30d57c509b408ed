//! Our own exponential.

use splat_kernels::exp::exp_neg_each;

use crate::device::{client, download, upload};

#[test]
fn the_exponential_is_exact_to_two_ulp_on_the_range_of_visible_splats() {
    let Some(client) = client() else { return };
    let sigmas: Vec<f32> = (0..=1_600_000).map(|i| i as f32 * 1e-5).collect();
    let values = download(&client, &exp_neg_each(&client, &upload(&client, &sigmas)));
    let error = |sigma: f32, value: f32| (f64::from(value) / (-f64::from(sigma)).exp() - 1.0).abs();
    let pairs = sigmas.iter().zip(&values);
    let worst = pairs.fold(0.0f64, |worst, (s, v)| worst.max(error(*s, *v)));
    println!("worst relative error {worst:.2e}");
    assert!(worst < 2e-7, "worst relative error {worst:e}");
    assert_eq!(values[0], 1.0);

    let beyond = upload(&client, &[80.0, 1e9, f32::INFINITY, f32::NAN]);
    for value in download(&client, &exp_neg_each(&client, &beyond)) {
        assert!(value < 1e-30, "{value:e}");
    }
}
