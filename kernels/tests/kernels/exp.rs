//! Tests of the exponential.

use splat_kernels::exp::exp2_neg_each;

use crate::device::{client, download, upload};

#[test]
fn the_exponential_is_exact_to_two_ulp_on_the_range_of_visible_splats() {
    let Some(client) = client() else { return };
    let exponents: Vec<f32> = (0..=2_400_000).map(|i| i as f32 * 1e-5).collect();
    let values = download(
        &client,
        &exp2_neg_each(&client, &upload(&client, &exponents)),
    );
    let error = |t: f32, value: f32| (f64::from(value) / (-f64::from(t)).exp2() - 1.0).abs();
    let pairs = exponents.iter().zip(&values);
    let worst = pairs.fold(0.0f64, |worst, (t, v)| worst.max(error(*t, *v)));
    println!("worst relative error {worst:.2e}");
    assert!(worst < 2e-7, "worst relative error {worst:e}");
    assert_eq!(values[0], 1.0);

    let beyond = upload(&client, &[115.0, 1e9, f32::INFINITY, f32::NAN]);
    for value in download(&client, &exp2_neg_each(&client, &beyond)) {
        assert!(value < 1e-30, "{value:e}");
    }
}
