//! Tests of the radix sort.

use rand::RngExt;
use splat_kernels::Buffer;
use splat_kernels::sort::{bits_for, iota, sort_pairs};

use crate::device::{client, download_u32, rng};

/// Sorts `keys` on the device and with the standard library's stable sort.
fn check(name: &str, keys: &[u32], bits: u32) {
    let Some(client) = client() else { return };
    let mask = if bits == 32 {
        u32::MAX
    } else {
        (1 << bits) - 1
    };
    let mut expected: Vec<u32> = (0..keys.len() as u32).collect();
    expected.sort_by_key(|&i| keys[i as usize] & mask);
    let (sorted, order) = sort_pairs(
        &client,
        &Buffer::from_u32(&client, keys),
        &iota(&client, keys.len()),
        bits,
    );
    let order = download_u32(&client, &order);
    let sorted = download_u32(&client, &sorted);
    assert!(
        order == expected,
        "{name}: order differs from the stable sort's"
    );
    assert!(
        sorted
            .iter()
            .zip(&order)
            .all(|(key, &i)| *key == keys[i as usize]),
        "{name}: keys and values were separated"
    );
}

#[test]
fn sorting_is_that_of_the_standard_library() {
    let mut rng = rng(2);
    for len in [0, 1, 2, 255, 256, 257, 2048, 2049, 10_000] {
        let keys: Vec<u32> = (0..len).map(|_| rng.random()).collect();
        check(&format!("{len} random keys"), &keys, 32);
    }
    let keys: Vec<u32> = (0..(1 << 20) + 7).map(|_| rng.random()).collect();
    check("2^20 + 7 random keys", &keys, 32);
}

#[test]
fn equal_keys_stay_in_order() {
    let mut rng = rng(3);
    check("all keys equal", &[7; 5000], 32);
    let keys: Vec<u32> = (0..50_000).map(|_| rng.random_range(0..5)).collect();
    check("five keys", &keys, 3);
    let keys: Vec<u32> = (0..50_000)
        .map(|i| if i % 2 == 0 { 0 } else { u32::MAX })
        .collect();
    check("two extreme keys", &keys, 32);
    check("nothing to sort by", &keys, 0);
}

#[test]
fn only_the_given_bits_are_sorted_by() {
    let mut rng = rng(4);
    let keys: Vec<u32> = (0..20_000).map(|_| rng.random()).collect();
    for bits in [1, 3, 4, 5, 9, 17, 31] {
        check(&format!("{bits} bits"), &keys, bits);
    }
}

#[test]
fn bits_are_counted() {
    for (count, bits) in [
        (0, 0),
        (1, 0),
        (2, 1),
        (3, 2),
        (4, 2),
        (5, 3),
        (511, 9),
        (512, 9),
        (513, 10),
    ] {
        assert_eq!(bits_for(count), bits, "{count}");
    }
}
