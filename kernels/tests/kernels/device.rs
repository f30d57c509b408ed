//! The device for tests, and helpers.

use cubecl::client::Client;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;
use splat_kernels::Buffer;

/// A client of the default wgpu adapter, software ones included, with kernels forced to the variant
/// of this test program: with planes or without. Prints a message and returns `None` if there is no
/// adapter.
pub fn client() -> Option<Client> {
    let client = crate::adapter::find()?;
    splat_kernels::force_plane_size(Some(0));
    if crate::PLANES {
        // Software devices do not report planes, but may have them.
        let hardware = &client.properties().hardware;
        let size = hardware.plane_size_max;
        if let Ok(required) = std::env::var("SPLAT_REQUIRE_PLANES") {
            assert_eq!(
                size.to_string(),
                required,
                "the size of the device's planes"
            );
        }
        splat_kernels::force_plane_size((hardware.plane_size_min == size).then_some(size));
        if splat_kernels::plane_size(&client).is_none() {
            eprintln!("\n*** SKIPPED: no planes of one known size here ***\n");
            return None;
        }
    }
    Some(client)
}

pub fn rng(seed: u64) -> Pcg32 {
    Pcg32::seed_from_u64(seed)
}

/// `len` floats in [low, high).
pub fn uniform(rng: &mut Pcg32, len: usize, low: f32, high: f32) -> Vec<f32> {
    (0..len).map(|_| rng.random_range(low..high)).collect()
}

pub fn upload(client: &Client, values: &[f32]) -> Buffer {
    Buffer::from_f32(client, values)
}

pub fn download(client: &Client, buffer: &Buffer) -> Vec<f32> {
    buffer.read_f32(client).expect("the device answers")
}

pub fn download_u32(client: &Client, buffer: &Buffer) -> Vec<u32> {
    buffer.read_u32(client).expect("the device answers")
}

/// |a - b| / |b| over all entries; the absolute error where b is all zero.
pub fn relative_l2(a: &[f32], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    let error: f64 = a
        .iter()
        .zip(b)
        .map(|(a, b)| (f64::from(*a) - b).powi(2))
        .sum();
    let norm: f64 = b.iter().map(|b| b * b).sum();
    if norm > 0.0 {
        (error / norm).sqrt()
    } else {
        error.sqrt()
    }
}

/// Fails unless `a` is within `limit` of `b` in relative L2 (NaN fails too).
pub fn assert_close(name: &str, a: &[f32], b: &[f64], limit: f64) {
    let error = relative_l2(a, b);
    println!("{name}: relative L2 {error:.2e} (limit {limit:.0e})");
    assert!(error <= limit, "{name}: relative L2 {error:e} > {limit:e}");
}

/// Central differences of a scalar function in float64, in every parameter.
pub fn differences(at: &[f64], step: f64, f: impl Fn(&[f64]) -> f64) -> Vec<f64> {
    let mut x = at.to_vec();
    (0..at.len())
        .map(|i| {
            let h = step * at[i].abs().max(1e-2);
            x[i] = at[i] + h;
            let above = f(&x);
            x[i] = at[i] - h;
            let below = f(&x);
            x[i] = at[i];
            (above - below) / (2.0 * h)
        })
        .collect()
}

pub fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|v| f64::from(*v)).collect()
}
