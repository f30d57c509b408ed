//! Tests of prefix sums.

use rand::RngExt;
use splat_kernels::{Buffer, scan};

use crate::device::{client, download_u32, rng};

#[test]
fn prefix_sums_of_any_length_equal_those_of_the_standard_library() {
    let Some(client) = client() else { return };
    let mut rng = rng(1);
    for len in [0, 1, 255, 256, 257, 2047, 2048, 2049, (1 << 20) + 7] {
        let values: Vec<u32> = (0..len).map(|_| rng.random_range(0..1000)).collect();
        let mut running = 0u32;
        let (exclusive, inclusive): (Vec<u32>, Vec<u32>) = values
            .iter()
            .map(|value| {
                running += value;
                (running - value, running)
            })
            .unzip();
        let input = Buffer::from_u32(&client, &values);
        assert_eq!(
            download_u32(&client, &scan::exclusive_sum(&client, &input)),
            exclusive,
            "{len}"
        );
        assert_eq!(
            download_u32(&client, &scan::inclusive_sum(&client, &input)),
            inclusive,
            "{len}"
        );
        let (sums, total) = scan::exclusive_sum_with_total(&client, &input);
        assert_eq!(download_u32(&client, &sums), exclusive, "{len}");
        assert_eq!(total.wait(), Ok(u64::from(running)), "{len}");
    }
}

#[test]
fn the_total_is_counted_in_64_bits() {
    let Some(client) = client() else { return };
    let input = Buffer::from_u32(&client, &[1 << 20; 8192]);
    let (_, total) = scan::exclusive_sum_with_total(&client, &input);
    assert_eq!(total.wait(), Ok(8192 << 20));
}
